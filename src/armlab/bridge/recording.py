"""`Recording`: rows and events of one run, in a file, or in memory when there is none."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from armlab.log import Column, Log, Recorder, Table, Tail, Tick
from armlab.robots import Robot
from armlab.state import Command, State

__all__ = ["Recording"]

_KEPT_SECONDS = 10.0  # in `.table` of errors
_KEPT_EVENTS = 1000
_logger = logging.getLogger("armlab.bridge")


class Recording:
    """Where the rows of a run go.

    Parameters
    ----------
    robot : the arm. path : file to write, None keeps the rows in memory. extra : the controller's own columns.
    wait : never drop a row (a link in lockstep keeps no real time). clock : stamps of events, wall clock [ns].

    Attributes
    ----------
    path : the file, None without one. events : the last sentences, with their stamps.
    """

    def __init__(
        self,
        robot: Robot,
        path: str | Path | None,
        extra: Mapping[str, Column] | None,
        *,
        wait: bool,
        clock: Callable[[], int],
    ) -> None:
        self._recorder = None if path is None else Recorder(path, robot, extra=extra, wait=wait)
        self._log = Log(robot, extra) if path is None else Tail(_KEPT_SECONDS, robot, extra)
        self._clock = clock
        self._told: set[str] = set()
        self.path = None if self._recorder is None else self._recorder.path
        self.events: deque[tuple[int, str]] = deque(maxlen=_KEPT_EVENTS)

    def row(self, state: State, command: Command | None, tick: Tick) -> None:
        """Keep one row.

        Parameters
        ----------
        state : what the controller saw. command : what it returned. tick : what the bridge knows.
        """
        try:
            self._log.row(state, command, tick)
        except Exception as error:  # what a controller returned may be anything
            if str(error) not in self._told:
                self._told.add(str(error))
                self.event(f"A row was kept without its command: {error}", warn=True)
            command = None
            self._log.row(state, None, tick)
        if self._recorder is not None:
            self._recorder.row(state, command, tick)

    def event(self, text: str, warn: bool = False) -> None:
        """Keep a sentence; it also goes to the logger ``armlab.bridge``, as a warning when something is wrong."""
        stamp = self._clock()
        self.events.append((stamp, text))
        _logger.log(logging.WARNING if warn else logging.INFO, text)
        if self._recorder is not None:
            self._recorder.event(text, stamp)

    def tail(self) -> Table:
        """Return the last ten seconds."""
        table = self._log.table()
        return table.between(table.t[-1] - _KEPT_SECONDS, float("inf")) if len(table) else table

    def table(self) -> Table:
        """Return all rows: of the file once it is closed, else of memory."""
        if self.path is None:
            return self._log.table()
        from armlab import log

        return log.read(self.path)

    def close(self, summary: Mapping[str, Any]) -> list[str]:
        """Finish the file. Return what went wrong with it, in sentences.

        Parameters
        ----------
        summary : numbers kept in the file.
        """
        recorder = self._recorder
        if recorder is None:
            return []
        recorder.close(dict(summary))
        problems = [f"The recording stopped: {recorder.failed}"] if recorder.failed else []
        if recorder.dropped:
            problems.append(f"The recording lost {recorder.dropped} rows: the disk was too slow.")
        return problems
