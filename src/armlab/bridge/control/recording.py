"""`Recording`: rows and events of one arm in a run, in a file, or in memory when there is none; and to feeds."""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

from armlab.bridge.inputs.parameters import Change
from armlab.bridge.net.events import Limited
from armlab.log import Column, Log, Recorder, Table, Tail, Tick
from armlab.robots import Robot
from armlab.state import Command, State

_KEPT_SECONDS = 10.0  # in `.table` of errors
_KEPT_EVENTS = 1000
_logger = logging.getLogger("armlab.bridge")


class Feed(Protocol):
    """What else takes the rows and events of a run: called in the loop after the reply was sent, so it must be quick.

    A feed that raises is dropped, with an event. One that has a method ``begin(tell, files, keep)`` gets at the start
    where its own sentences are recorded, the files of the recording, and where changes of parameters are. What
    ``summary()`` of one returns is kept with the numbers of the run.
    """

    def row(self, state: State, command: Command | None, tick: Tick) -> None:
        """Take one row: of each packet of each arm, which `state.robot` names."""
        ...

    def event(self, text: str, warn: bool = False) -> None:
        """Take one sentence."""
        ...


def paths(record: str | Path | None, robots: Sequence[Robot]) -> list[Path | None]:
    """Return the file of each arm: the name given, with the side (else the name) of the arm added when several."""
    if record is None:
        return [None] * len(robots)
    path = Path(record)
    if len(robots) == 1:
        return [path]
    sides = [robot.side for robot in robots]
    ends = sides if all(sides) and len(set(sides)) == len(sides) else [f"-{robot.name}" for robot in robots]
    return [path.with_name(f"{path.stem}{end}{path.suffix}") for end in ends]


class Recording:
    """Where the rows of an arm go."""

    def __init__(
        self,
        robot: Robot,
        path: str | Path | None,
        extra: Mapping[str, Column] | None,
        *,
        attachments: Mapping[str, bytes] | None = None,
        wait: bool,
        clock: Callable[[], int],
        feeds: list[Feed] | None = None,
        label: str = "",
    ) -> None:
        options: dict[str, Any] = {"extra": extra, "attachments": attachments, "wait": wait}
        self._recorder = None if path is None else Recorder(path, robot, **options)
        self._log = Log(robot, extra) if path is None else Tail(_KEPT_SECONDS, robot, extra)
        self._clock, self._label = clock, label
        self._feeds = [] if feeds is None else feeds
        self._told: set[str] = set()
        self._limited = Limited(self._keep)
        self.path = None if self._recorder is None else self._recorder.path
        self.events: deque[tuple[int, str]] = deque(maxlen=_KEPT_EVENTS)
        self._early: list[Callable[[int], None]] = []  # what waits for its stamp

    def keep(self, state: State, command: Command | None, tick: Tick) -> Command | None:
        """Keep one row in memory. Return the command as it could be kept with it, None when it could not be."""
        if self._early:
            self._stamp_early(tick.stamp_ns)
        try:
            self._log.row(state, command, tick)
        except MemoryError:  # no fault of the command
            raise
        except Exception as error:  # what a controller returned may be anything
            command = self._keep_less(state, command, tick, error)
        return command

    def _keep_less(self, state: State, command: Any, tick: Tick, error: Exception) -> Command | None:
        """Keep a row without what the controller recorded; without the command where this is none, which is refused."""
        try:
            command = replace(command, record={})
            self._log.row(state, command, tick)
        except MemoryError:
            raise
        except Exception:
            self._log.row(state, None, tick)
            return None
        if str(error) not in self._told:
            self._told.add(str(error))
            self.event(f"A row was kept without what the controller recorded: {error}", warn=True)
        return command

    def publish(self, state: State, command: Command | None, tick: Tick) -> None:
        if self._recorder is not None and not self._recorder.row(state, command, tick):
            self._tell_stop(self._recorder)
        if self._feeds:
            self._tell_feeds(lambda feed: feed.row(state, command, tick))
        if self._limited.waiting:
            self.catch_up()

    def event(self, text: str, warn: bool = False, each: bool = False) -> None:
        """Keep a sentence; it also goes to the logger ``armlab.bridge``, as a warning when something is wrong."""
        self.note(f"{self._label}: {text}" if self._label else text, warn, each)

    def note(self, text: str, warn: bool = False, each: bool = False) -> None:
        """Keep a sentence that concerns the whole run; see `event`, and `Limited` for those that come too often."""
        self._limited(text, warn, self._clock(), each)

    def parameter(self, change: Change) -> None:
        recorder = self._recorder
        if recorder is not None:
            self._stamped(lambda stamp: recorder.parameter(*change, stamp), self._clock())

    def catch_up(self) -> None:
        """Keep sentences that waited, since others of their kind had come."""
        if self._limited.waiting:
            self._limited.due(self._clock())

    def _keep(self, text: str, warn: bool, stamp: int) -> None:
        _logger.log(logging.WARNING if warn else logging.INFO, text)
        self._stamped(lambda stamp: self._write_event(text, stamp), stamp)
        if self._feeds:
            self._tell_feeds(lambda feed: feed.event(text, warn))

    def _write_event(self, text: str, stamp: int) -> None:
        self.events.append((stamp, text))
        if self._recorder is not None:
            self._recorder.event(text, stamp)

    def _stamped(self, write: Callable[[int], None], stamp: int) -> None:
        """Write with a stamp; in lockstep, before the first packet, there is none: the first row gives it."""
        if stamp:
            write(stamp)
        else:
            self._early.append(write)

    def _stamp_early(self, stamp: int) -> None:
        waiting, self._early = self._early, []
        for write in waiting:
            write(stamp)

    def _tell_feeds(self, tell: Callable[[Feed], None]) -> None:
        for feed in tuple(self._feeds):
            try:
                tell(feed)
            except Exception as error:  # a feed must not stop the loop
                if feed in self._feeds:
                    self._feeds.remove(feed)
                self.event(f"A feed was dropped: it raised {type(error).__name__}: {error}.", warn=True)

    def _tell_stop(self, recorder: Recorder) -> None:
        """Say once, while there is still something to be done about it, that nothing is written any more."""
        if recorder.failed is not None and recorder.failed not in self._told:
            self._told.add(recorder.failed)
            self.event(f"The recording stopped: {recorder.failed}", warn=True)

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
        """Finish the file. Return what went wrong with it, in sentences."""
        self._limited.close()
        self._stamp_early(time.time_ns())  # no packet came
        recorder = self._recorder
        if recorder is None:
            return []
        recorder.close(dict(summary))
        self._tell_stop(recorder)
        problems = [f"The recording stopped: {recorder.failed}"] if recorder.failed else []
        if recorder.dropped:
            why = "they came after it stopped" if recorder.failed else "the disk was too slow"
            problems.append(f"The recording lost {recorder.dropped} rows: {why}.")
        return problems
