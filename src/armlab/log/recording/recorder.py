"""`Log` and `Tail` hold rows in memory; `Recorder` writes rows to an MCAP file without blocking the loop.

The writing thread polls the queue. If the loop woke the thread, every cycle would cost a system call, and both threads
would contend for the GIL.
"""

from __future__ import annotations

import atexit
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from armlab._numbers import positive
from armlab.errors import LogError
from armlab.log.assembly import recording_table
from armlab.log.column import OLD_NAMES, Column
from armlab.log.recording.file import RecordingFile, recording_path
from armlab.log.recording.rows import RowLayout, Tick
from armlab.log.table import Table
from armlab.robots import Robot
from armlab.state import Command, State

_TAIL_RATE = 500.0  # rows per second in a Tail; EGM's highest rate is 250
_TAIL_ROWS = 1 << 40  # exceeds any memory


class Log:
    """In-memory log of the standard and the user-defined columns; grows without copying.

    Parameters
    ----------
    robot : robot whose joints define the columns.
    extra : user-defined columns, name -> `Column` with shape, unit and frame.

    Examples
    --------
    >>> log = Log(robot, extra={"fext": Column(shape=(6,), unit="N", frame="base")})
    >>> log.push(t=0.0, q=q, fext=f)
    >>> log.table()["fext"]
    """

    def __init__(self, robot: Robot, extra: Mapping[str, Column] | None = None) -> None:
        self._robot = robot
        self._layout = RowLayout(robot, {**(extra or {}), "t": Column()})
        self._rows: deque[bytes] = deque()  # bytes are not scanned by the garbage collector
        self._start_ns = time.time_ns() - time.monotonic_ns()
        self._pushed = 0

    def __len__(self) -> int:
        return len(self._rows)

    def push(self, **values: Any) -> None:
        """Append one row by column name; omitted values are missing.

        The field names of logs from the predecessor software (pos vel trq pos_o vel_o trq_o timestamp seqnum) are
        accepted as aliases. `t` is the row's time [s], given for all rows or none; default: the time of the call.

        Raises
        ------
        UnknownName, ShapeError : a name or shape is invalid; nothing is then stored.
        """
        values = {OLD_NAMES.get(name, name): value for name, value in values.items()}
        stamp = self._start_ns + time.monotonic_ns()
        standard = {"tick": self._pushed, "session": 1, "stamp_ns": stamp}
        self._rows.append(self._layout.pack_values({**standard, **values}))
        self._pushed += 1

    def row(self, state: State, command: Command | None, tick: Tick) -> None:
        """Append the bridge data of one tick.

        Raises
        ------
        ShapeError : an array has the wrong number of values.
        """
        self._rows.append(self._layout.pack(state, command, tick))

    def table(self) -> Table:
        """Return a copy of the rows appended so far as a table."""
        values = self._layout.unpack(self._rows.copy())
        columns = {name: slot.column for name, slot in self._layout.slots.items()}
        return recording_table(values, columns, values.pop("stamp_ns"))

    def save(self, path: str | Path, *, note: str = "") -> Path:
        """Write the rows appended so far to a finished recording, and return its path.

        ``log.read(log.save(path))`` equals `table()`, except that poses are stored as quaternions.

        Parameters
        ----------
        path : output file, with the extension .mcap; ``-2``, ``-3``, ... is appended to the name if the file exists.
        note : free text, stored in the metadata.

        Raises
        ------
        ConfigError : the extension is not .mcap; `write` creates other formats from `table()`.
        LogError : the file cannot be written; no partial file remains.
        """
        rows = self._rows.copy()
        file = RecordingFile(recording_path(path), self._robot, self._layout, {}, note)
        try:
            file.write(list(rows), 0)
            file.finish({"rows": len(rows)})
        except BaseException as error:
            file.abandon()
            file.path.unlink(missing_ok=True)
            if isinstance(error, OSError):
                raise LogError(f"Expected to write the log {file.path}, got: {error.strerror}.") from None
            raise
        return file.path


class Tail(Log):
    """Ring buffer with the last seconds of a log.

    Parameters
    ----------
    seconds : retained duration [s].
    robot, extra : as in `Log`.
    """

    def __init__(self, seconds: float, robot: Robot, extra: Mapping[str, Column] | None = None) -> None:
        self.seconds: float = positive(seconds, "length of a Tail [s]", "Try 60.")
        super().__init__(robot, extra)
        self._rows = deque(maxlen=int(min(self.seconds * _TAIL_RATE, _TAIL_ROWS)) + 1)

    def table(self) -> Table:
        """Return the rows of the last `seconds`."""
        table = super().table()
        return table.between(table.t[-1] - self.seconds, np.inf) if len(table) else table


class Syncing:
    """Thread that syncs a file on request.

    If the disk is slow, written data remain in kernel memory. These data survive a process crash and reach the disk
    with the next sync.
    """

    def __init__(self, sync: Callable[[], None], name: str) -> None:
        self._sync = sync
        self._asked = threading.Event()
        self._closed = False
        self._error: OSError | None = None
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def ask(self) -> None:
        self._check()
        self._asked.set()

    def close(self) -> None:
        """End the thread after the current sync."""
        self._closed = True
        self._asked.set()
        self._thread.join()
        self._check()

    def _check(self) -> None:
        if self._error is not None:
            raise self._error

    def _run(self) -> None:
        try:
            while True:
                self._asked.wait()
                self._asked.clear()
                if self._closed:
                    return
                self._sync()
        except OSError as error:
            self._error = error


WRITE_PERIOD = 0.04  # s, maximum loss in a process crash
FLUSH_PERIOD = 0.8  # s, maximum loss in a power failure
QUEUE_ROWS = 2500  # 10 s at 250 Hz
MANY_ROWS = 1250  # number of queued rows that triggers an immediate write
MOST_COMPLAINTS = 100


class Recorder:
    """Recording of one arm: `row()` in the loop, and a thread that writes the queued rows every 40 ms.

    Parameters
    ----------
    path : output file, with the extension .mcap; ``-2``, ``-3``, ... is appended to the name if the file exists. The
        attribute `path` holds the actual name.
    robot : the arm; its name is the first part of every topic.
    extra : additional columns of the controller (``Command.record``); `wrench_hat` and `wrench_hat_cov` are built in.
    attachments : name -> bytes stored in the file, for example the robot's description and the model.
    note : free text, stored in the metadata.
    wait : block `row()` while the queue is full instead of dropping rows. Used by lockstep links, which do not run in
        real time.

    Attributes
    ----------
    rows, dropped : number of accepted rows, and number of dropped rows.
    failed : reason why the recorder stopped, or None.

    Raises
    ------
    ConfigError : the extension is not .mcap.
    LogError : the file cannot be created or written.
    ShapeError, UnknownName : a declared column is invalid.

    Notes
    -----
    Each row is packed into bytes and added to a queue that holds 10 s of rows. If the queue is full, new rows are
    dropped and counted, and two events mark the gap. A thread passes all rows to the kernel every 40 ms, so if the
    process is killed, only the rows since the last transfer are lost. Another thread syncs the file every 0.8 s to
    bound the loss in a power failure; a slow sync does not delay rows. A write error stops the recorder, but never the
    loop.
    """

    def __init__(
        self,
        path: str | Path,
        robot: Robot,
        *,
        extra: Mapping[str, Column] | None = None,
        attachments: Mapping[str, bytes] | None = None,
        note: str = "",
        wait: bool = False,
    ) -> None:
        self._layout = RowLayout(robot, extra)
        self._pack, self._known = self._layout.pack, self._layout.extra.keys()
        self._file = RecordingFile(recording_path(path), robot, self._layout, dict(attachments or {}), note)
        self.path: Path = self._file.path
        self.rows: int = 0
        self.dropped: int = 0
        self.failed: str | None = None
        self._stopped = f"Recording to {self.path} stopped."
        self._wait = wait
        self._holes: list[tuple[int, int, int]] = []  # first tick, last tick, rows
        self._hole: tuple[int, int, int] | None = None
        self._complained: set[str] = set()
        self._closed = False
        self._queue: deque[bytes | Callable[[], None]] = deque()  # append and popleft are atomic
        self._wake = threading.Event()
        self._syncing = Syncing(self._file.to_disk, f"sync {self.path.name}")
        self._thread = threading.Thread(target=self._run, name=f"recorder {self.path.name}", daemon=True)
        self._thread.start()
        atexit.register(self.close)

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def row(self, state: State, command: Command | None, tick: Tick) -> bool:
        """Queue one row; return False if it is dropped. This method never raises, and blocks only if `wait` is set.

        Parameters
        ----------
        state : input of the controller.
        command : output of the controller, None if it was not called.
        tick : bridge data of the tick.
        """
        if self._closed or (len(self._queue) >= MANY_ROWS and not self._has_room()) or self.failed is not None:
            return self._drop(tick)
        try:
            row = self._pack(state, command, tick)
            if command is not None and not command.record.keys() <= self._known:
                unknown = ", ".join(sorted(map(str, command.record.keys() - self._known)))
                self._complain(f"columns not written, because extra= does not declare them: {unknown}", tick)
        except Exception as error:  # catches all errors: an invalid row must not stop the loop
            self._complain(f"row not written: {str(error) or type(error).__name__}", tick)
            return self._drop(tick)
        if self._hole is not None:
            self._end_hole(tick.stamp_ns)
        self._queue.append(row)
        self.rows += 1
        return True

    def event(self, text: str, stamp_ns: int) -> None:
        """Queue one event unless the recording has stopped."""
        if self.failed is None:
            self._queue.append(partial(self._file.event, text, stamp_ns))

    def parameter(self, sequence: int, name: str, value: Any, who: str, stamp_ns: int) -> None:
        """Queue a new parameter value unless the recording has stopped.

        Parameters
        ----------
        sequence : number of the change.
        name, value : name and new value of the parameter.
        who : author of the change.
        stamp_ns : wall-clock time.
        """
        if self.failed is None:
            self._queue.append(partial(self._file.parameter, sequence, name, value, who, stamp_ns))

    def close(self, summary: Mapping[str, Any] | None = None) -> None:
        """Write the queue, the summary and the footer, and close the file. Idempotent.

        Parameters
        ----------
        summary : stored in the file as summary.json, together with the counts of the recorder.
        """
        if self._closed:
            return
        self._closed = True
        atexit.unregister(self.close)
        if self._hole is not None:
            self._end_hole(self._file.last_stamp_ns)
        self._wake.set()
        self._thread.join()
        self._guarded(self._syncing.close)
        self.dropped += self.rows - self._file.rows  # rows in the queue when the disk failed
        self.rows = self._file.rows
        counts = {"rows": self.rows, "dropped": self.dropped, "holes": self._holes}
        if self.failed is None:
            self._guarded(lambda: self._file.finish({**(summary or {}), **counts}))

    def _run(self) -> None:
        self._guarded(self._write_queue)

    def _write_queue(self) -> None:
        """Write queued items until the recorder is closed."""
        due, is_last = time.monotonic() + FLUSH_PERIOD, False
        while not is_last:
            self._wake.wait(WRITE_PERIOD)
            self._wake.clear()
            is_last = self._closed  # read before draining the queue, to include all earlier rows
            self._write([self._queue.popleft() for _ in range(len(self._queue))])
            if time.monotonic() >= due:
                self._file.close_chunk()
                self._syncing.ask()
                due = time.monotonic() + FLUSH_PERIOD

    def _write(self, items: list[bytes | Callable[[], None]]) -> None:
        """Write rows, and the items between them, in order."""
        rows: list[bytes] = []
        for item in items:
            if isinstance(item, bytes):
                rows.append(item)
            else:
                self._file.write(rows)
                rows = []
                item()
        self._file.write(rows)

    def _guarded(self, work: Callable[[], None]) -> None:
        """Run a file operation; an error stops the recorder and is stored in `failed`."""
        try:
            work()
        except Exception as error:  # the loop must continue, and no caller could catch the error
            try:
                reason = getattr(error, "strerror", None) or f"{type(error).__name__}: {error}"
                self.failed = f"Recording to {self.path} stopped after {self._file.rows} rows: {reason}."
            except Exception:  # not enough memory for a message
                self.failed = self._stopped
            self._file.abandon()

    def _has_room(self) -> bool:
        """Trigger early writing of a long queue; return whether the queue has room (with `wait`: wait for room)."""
        self._wake.set()
        while self._wait and len(self._queue) >= QUEUE_ROWS and self.failed is None:
            time.sleep(0.001)
        return len(self._queue) < QUEUE_ROWS

    def _drop(self, tick: Tick) -> bool:
        self.dropped += 1
        if self._hole is None:
            self._hole = (tick.number, tick.number, 0)
            self.event(f"dropping rows from tick {tick.number} on, {len(self._queue)} rows queued", tick.stamp_ns)
        first, _, count = self._hole
        self._hole = (first, tick.number, count + 1)
        return False

    def _end_hole(self, stamp_ns: int) -> None:
        hole, self._hole = self._hole, None
        if hole is not None:
            self._holes.append(hole)
            self.event(f"{hole[2]} rows dropped, ticks {hole[0]} to {hole[1]}", stamp_ns)

    def _complain(self, text: str, tick: Tick) -> None:
        """Write an event unless it repeats an earlier one; the number of events is limited, so that changing messages
        cannot fill the disk."""
        if text not in self._complained and len(self._complained) < MOST_COMPLAINTS:
            self._complained.add(text)
            self.event(text, tick.stamp_ns)
