"""`Recording`: rows and events of one arm during a run, stored in a file or in memory and passed to feeds."""

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

_KEPT_SECONDS = 10.0  # s of rows in the attribute `table` of errors
_KEPT_EVENTS = 1000
_logger = logging.getLogger("armlab.bridge")


class Feed(Protocol):
    """Additional consumer of the rows and events of a run; the loop calls the feed after each reply, so the feed must
    be fast.

    A feed that raises an error is dropped, and an event reports the error. Optional methods: ``begin(tell,
    files, keep)`` is called at the start with the event callback, the recording files and the callback for parameter
    changes; ``summary()`` returns a dict to add to the run statistics.
    """

    def row(self, state: State, command: Command | None, tick: Tick) -> None:
        """Receive the recording row of one packet; `state.robot` names the arm."""
        ...

    def event(self, text: str, warn: bool = False) -> None:
        """Receive one event."""
        ...


def paths(record: str | Path | None, robots: Sequence[Robot]) -> list[Path | None]:
    """Return the file of each arm; with several arms, file names contain the arm's side or name."""
    if record is None:
        return [None] * len(robots)
    path = Path(record)
    if len(robots) == 1:
        return [path]
    sides = [robot.side for robot in robots]
    ends = sides if all(sides) and len(set(sides)) == len(sides) else [f"-{robot.name}" for robot in robots]
    return [path.with_name(f"{path.stem}{end}{path.suffix}") for end in ends]


class Recording:
    """Records the rows and events of one arm."""

    path: Path | None

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
        self._reported: set[str] = set()
        self._limited = Limited(self._keep)
        self._held: deque[tuple[str, bool, int, bool]] = (
            deque()
        )  # events since the last row; writing them must not delay a reply
        self.path = None if self._recorder is None else self._recorder.path
        self.events: deque[tuple[int, str]] = deque(maxlen=_KEPT_EVENTS)
        self._early: list[Callable[[int], None]] = []  # entries waiting for the time stamp of the first row

    def keep(self, state: State, command: Command | None, tick: Tick) -> Command | None:
        """Store one row in memory; return the stored command, or None if the command could not be stored."""
        if self._held or self._limited.waiting:
            self.catch_up()
        if self._early:
            self._stamp_early(tick.stamp_ns)
        try:
            self._log.row(state, command, tick)
        except MemoryError:  # not caused by the command
            raise
        except Exception as error:  # a controller may return anything
            command = self._keep_less(state, command, tick, error)
        return command

    def _keep_less(self, state: State, command: Any, tick: Tick, error: Exception) -> Command | None:
        """Store a row without the controller's record and, if the command is invalid, without the command."""
        try:
            command = replace(command, record={})
            self._log.row(state, command, tick)
        except MemoryError:
            raise
        except Exception:
            self._log.row(state, None, tick)
            return None
        if str(error) not in self._reported:
            self._reported.add(str(error))
            self.event(f"A row was stored without the controller's record: {error}", warn=True)
        return command

    def publish(self, state: State, command: Command | None, tick: Tick) -> None:
        if self._feeds:  # first, because clients wait for the row
            self._call_feeds(lambda feed: feed.row(state, command, tick))
        if self._recorder is not None and not self._recorder.row(state, command, tick):
            self._report_stop(self._recorder)
        if self._feeds:
            self.catch_up()

    def event(self, text: str, warn: bool = False, each: bool = False) -> None:
        """Store an event of this arm and send it to the logger ``armlab.bridge``; `warn` selects the warning level."""
        self.note(f"{self._label}: {text}" if self._label else text, warn, each)

    def note(self, text: str, warn: bool = False, each: bool = False) -> None:
        """Store an event of the whole run with the next row; see `event` and, for the rate limit, `Limited`."""
        self._held.append((text, warn, self._clock(), each))

    def parameter(self, change: Change) -> None:
        recorder = self._recorder
        if recorder is not None:
            self._stamped(lambda stamp: recorder.parameter(*change, stamp), self._clock())

    def catch_up(self) -> None:
        """Store the events since the last row, and any events delayed by the rate limit."""
        while self._held:
            self._limited(*self._held.popleft())
        if self._limited.waiting:
            self._limited.due(self._clock())

    def _keep(self, text: str, warn: bool, stamp: int) -> None:
        def write(stamp: int) -> None:
            self.events.append((stamp, text))
            if self._recorder is not None:
                self._recorder.event(text, stamp)

        _logger.log(logging.WARNING if warn else logging.INFO, text)
        self._stamped(write, stamp)
        if self._feeds:
            self._call_feeds(lambda feed: feed.event(text, warn))

    def _stamped(self, write: Callable[[int], None], stamp: int) -> None:
        """Write an entry with a time stamp; in lockstep, entries before the first packet are held until the first
        row."""
        if stamp:
            write(stamp)
        else:
            self._early.append(write)

    def _stamp_early(self, stamp: int) -> None:
        waiting, self._early = self._early, []
        for write in waiting:
            write(stamp)

    def _call_feeds(self, call: Callable[[Feed], None]) -> None:
        for feed in tuple(self._feeds):
            try:
                call(feed)
            except Exception as error:  # an error in a feed must not stop the loop
                if feed in self._feeds:
                    self._feeds.remove(feed)
                self.event(f"A feed was dropped: it raised {type(error).__name__}: {error}.", warn=True)

    def _report_stop(self, recorder: Recorder) -> None:
        """Report a failed recording once, while the user can still fix the cause."""
        if recorder.failed is not None and recorder.failed not in self._reported:
            self._reported.add(recorder.failed)
            self.event(f"The recording stopped: {recorder.failed}", warn=True)

    def tail(self) -> Table:
        """Return the rows of the last ten seconds."""
        table = self._log.table()
        return table.between(table.t[-1] - _KEPT_SECONDS, float("inf")) if len(table) else table

    def table(self) -> Table:
        """Return all rows, from the closed file or from memory."""
        if self.path is None:
            return self._log.table()
        from armlab import log

        return log.read(self.path)

    def close(self, summary: Mapping[str, Any]) -> list[str]:
        """Close the file; return any problems with the recording, one sentence each."""
        self.catch_up()
        self._limited.close()
        self._stamp_early(time.time_ns())  # if no packet arrived
        recorder = self._recorder
        if recorder is None:
            return []
        recorder.close(dict(summary))
        self._report_stop(recorder)
        self.catch_up()
        problems = [f"The recording stopped: {recorder.failed}"] if recorder.failed else []
        if recorder.dropped:
            why = "the recorder had already stopped" if recorder.failed else "the disk was too slow"
            problems.append(f"The recording lost {recorder.dropped} rows: {why}.")
        return problems
