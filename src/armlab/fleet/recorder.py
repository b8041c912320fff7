"""`FleetRecorder` records rows of many robots over Zenoh, in one file per robot and bridge run."""

from __future__ import annotations

import contextlib
import math
import re
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from armlab.bridge.servers.row import MAGIC, RowSchema
from armlab.bridge.servers.zenoh.messages import EVERY, Inbox, key, read_about, robot_of, undamaged
from armlab.bridge.servers.zenoh.session import Discovery, LabAddress, close_session, zenoh
from armlab.errors import ArmlabError, LinkError
from armlab.log.recording.file import RecordingFile
from armlab.log.recording.recorder import FLUSH_PERIOD, WRITE_PERIOD, Syncing
from armlab.log.recording.rows import SELDOM, RowLayout

_INBOX = 50_000  # messages, 20 s from ten robots; an overflow leaves gaps in the ticks
_ROBOTS = 1000
_ROOM = 2**28  # bytes of all rows waiting for descriptions: ten seconds from fifty robots
_NAME = re.compile(r"[\w+-][\w.+-]{0,99}")  # valid file names
_WALL = slice(32, 40)  # wall-clock time in the row header
_PAIR = struct.Struct("<qq")
_NAMES = 220  # bytes of lab and robot names; file systems allow 255, including number and extension


class FleetRecorder:
    """Context manager that records every robot that sends rows.

    A robot may disappear and return with a different row schema. Each bridge run has its own MCAP file:
    ``lab1-yumi_left.mcap``, then ``lab1-yumi_left-2.mcap``. Gaps in the robot's ticks reveal missing rows, which are
    listed in an event and in the summary of the file. A file that cannot be written is abandoned with a message. Any
    other error ends only the recording of the affected robot.

    Parameters
    ----------
    place : address of the router; its `lab` may be `EVERY`.
    folder : output folder.
    tell : callback for messages to the user, called in a thread of the recorder.

    Attributes
    ----------
    robots : `RobotRecord` by "lab/robot": rows, lost, damaged, refused, late, paths, failed.
    strangers : number of messages from unknown robots.

    Raises
    ------
    LinkError : no router at this address.
    MissingExtra : Zenoh is not installed.
    """

    def __init__(self, place: LabAddress, folder: str | Path, tell: Callable[[str], None] = lambda text: None) -> None:
        self._folder, self._tell = Path(folder), tell
        self._robots: dict[str, RobotRecord] = {}
        self._ended: set[str] = set()  # robots whose recording has ended
        self.strangers: int = 0
        self._inbox: Inbox[tuple[Callable[[RobotRecord], None], str]] = Inbox(_INBOX)
        self._room = _ROOM
        self._wake, self._closed = threading.Event(), False
        self._session = place.open_behind()
        self._asking = Discovery(self._session, self._answered)
        declare, liveliness = self._session.declare_subscriber, self._session.liveliness()
        self._thread = threading.Thread(target=self._run, name="fleet recorder", daemon=True)
        self._thread.start()
        self._rows = declare(key(place.lab, EVERY, "state"), self._take)
        self._alive = liveliness.declare_subscriber(key(place.lab, EVERY, "alive"), self._take_life, history=True)

    def __enter__(self) -> FleetRecorder:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def robots(self) -> Mapping[str, RobotRecord]:
        """Records by robot."""
        return dict(self._robots)

    def close(self) -> None:
        """Write all received rows, and finish all files."""
        if self._closed:
            return
        close_session(self._session)
        self._closed = True
        self._wake.set()
        self._thread.join()

    def _take(self, sample: Any) -> None:
        data = undamaged(sample)
        self._inbox.put((partial(self._row, data=data), str(sample.key_expr)), len(data or b""))

    def _take_life(self, sample: Any) -> None:
        has_come = sample.kind == zenoh().SampleKind.PUT
        self._inbox.put((partial(self._live, has_come=has_come), str(sample.key_expr)))

    def _row(self, robot: RobotRecord, data: bytes | None) -> None:
        """Store a row; if the buffer is full, the row is lost and leaves a gap in the ticks."""
        size = len(data or b"")
        if size <= self._room:
            self._room -= size
            robot.take(data)

    def _live(self, robot: RobotRecord, has_come: bool) -> None:
        text = "its bridge is connected" if has_come else "its bridge is disconnected"
        if not has_come:
            robot.doubt()
        robot.event(text)
        self._tell(f"{robot.name}: {text}")

    def _run(self) -> None:
        due, is_last = time.monotonic() + FLUSH_PERIOD, False
        while not is_last:
            self._wake.wait(WRITE_PERIOD)
            is_last = self._closed  # read before draining the inbox, to include all earlier messages
            for _ in range(len(self._inbox)):
                message = self._inbox.get()
                if message is None:
                    break
                work, where = message
                robot = self._robot(where)
                if robot is None:
                    self.strangers += 1
                else:
                    self._do(robot, work)
            for robot in self._robots.values():
                self._do(robot, RobotRecord.write)
                if robot.wants and not is_last:
                    lab, _, name = robot.name.partition("/")
                    self._asking.ask(lab, name)
            self._room = _ROOM - sum(robot.waiting for robot in self._robots.values())
            if time.monotonic() >= due:
                for robot in self._robots.values():
                    self._do(robot, RobotRecord.flush)
                due = time.monotonic() + FLUSH_PERIOD
        for robot in self._robots.values():
            self._do(robot, RobotRecord.close)

    def _do(self, robot: RobotRecord, work: Callable[[RobotRecord], None]) -> None:
        """Run a step for a robot; an error ends only this robot's recording."""
        if robot.name in self._ended:
            return
        try:
            work(robot)
        except Exception as error:
            self._ended.add(robot.name)
            with contextlib.suppress(OSError):  # raised while abandoning the file
                robot.end(f"{type(error).__name__}: {error}")

    def _robot(self, where: str) -> RobotRecord | None:
        lab, name = robot_of(where)
        full = f"{lab}/{name}"
        if full not in self._robots:
            is_name = _NAME.fullmatch(lab) and _NAME.fullmatch(name) and len(full.encode()) <= _NAMES
            if len(self._robots) >= _ROBOTS or not is_name:
                return None
            self._robots[full] = RobotRecord(full, self._folder / f"{lab}-{name}.mcap", self._tell)
        return self._robots[full]

    def _answered(self, lab: str, name: str, about: bytes) -> None:
        self._inbox.put((partial(RobotRecord.describe, about=about), key(lab, name, "about")), len(about))


_WAITING = 2500  # rows waiting for their description: 10 s
_STRANGE = 64  # number of remembered schemas of invalid rows
_UNANSWERED = 5.0  # s after which rows without a description are abandoned
_AGAIN = 10.0  # s between a failure to open or write a file and the next attempt
_SILENT = 60.0  # s without a row after which a file is finished
_MOST_HOLES = 10_000  # maximum number of gaps listed in a file


class RobotRecord:
    """Recordings of one robot; call all methods from one thread.

    Attributes
    ----------
    rows, lost : number of rows written, and number of rows missing or not written, according to the robot's ticks.
    damaged : number of rows with an invalid checksum, which are dropped and leave gaps.
    refused : number of messages that are not rows of this robot.
    late : number of rows dropped because an equal or newer tick had already been received.
    last : newest tick, -1 before the first row.
    paths : files so far.
    failed : reason why writing to the last file stopped, or None.
    wants : whether rows are waiting for a description.
    """

    rows: int
    lost: int
    damaged: int
    refused: int
    late: int
    wants: bool

    def __init__(self, name: str, path: Path, tell: Callable[[str], None]) -> None:
        self.name: str = name
        self._path, self._tell = path, tell
        self.rows = self.lost = self.damaged = self.refused = self.late = 0
        self.last: int = -1
        self.paths: list[Path] = []
        self.failed: str | None = None
        self.wants = self._is_unsure = False
        self._waiting: deque[bytes] = deque()
        self._strange: deque[bytes] = deque(maxlen=_STRANGE)
        self._since: float | None = None  # time since which rows have been waiting for a description
        self._run: _BridgeRun | None = None
        self._file: _RobotFile | None = None
        self._heard = self._retry = 0.0

    @property
    def waiting(self) -> int:
        """Bytes of the rows waiting to be written."""
        return sum(map(len, self._waiting))

    def take(self, data: bytes | None) -> None:
        """Store a row; if too many rows are waiting, the new row is lost and leaves a gap in the ticks."""
        if data is None:
            self.damaged += 1
            if self.damaged == 1:
                self._tell(f"{self.name}: damaged rows are dropped and leave gaps")
            if self._file is not None:
                self._file.damaged += 1
            self.event("a damaged row was dropped")
        elif len(self._waiting) < _WAITING:
            self._waiting.append(data)

    def doubt(self) -> None:
        """Process the disconnection of the bridge; subsequent rows may belong to another run."""
        self.write()
        self._is_unsure = self._run is not None

    def describe(self, about: bytes) -> None:
        """Process the description of a bridge and its robots; the waiting rows belong to a new run."""
        if not self.wants:
            return
        self.wants, self._since = False, None
        try:
            run = _BridgeRun(self.name.rpartition("/")[2], about)
        except (ArmlabError, KeyError) as error:
            self._refuse(f"its bridge sent an invalid description: {error}")
            return
        if self._waiting and self._waiting[0][8:16] != run.schema.id:
            self._strange.append(self._waiting[0][8:16])
            return
        if self._is_unsure:
            self._is_unsure = False
            if self._run is not None and self._run.id == run.id:
                return
            self._tell(f"{self.name}: its bridge has restarted")
        self._finish()
        self._run = run

    def write(self) -> None:
        now = time.monotonic()
        packed: list[bytes] = []
        self._heard = now if self._waiting else self._heard
        for _ in range(len(self._waiting) + 1):  # the end of a run requires a second pass
            if not self._waiting:
                break
            data = self._waiting[0]
            if self._run is None or self._is_unsure or data[8:16] != self._run.schema.id:
                if data[:4] != MAGIC or data[8:16] in self._strange:
                    self._waiting.popleft()
                    self._refuse("rows with a schema unknown to its bridge")
                    continue
                self.wants, self._since = True, self._since or now
                break
            try:
                row = self._run.columns.packed(data)
            except LinkError as error:
                self._waiting.popleft()
                self._refuse(str(error))
                continue
            if self._run.has_restarted(row):  # the bridge may send a new description
                self._put(packed)
                self._finish()
                self._run, packed = None, []
                self._tell(f"{self.name}: its bridge has restarted")
                continue
            self._waiting.popleft()
            packed = self._sorted(self._run, row, packed)
        self._put(packed)
        if self._since is not None and now - self._since > _UNANSWERED:
            self._give_up()
        if self._file is not None and now - self._heard > _SILENT:
            self._finish()

    def flush(self) -> None:
        if self._file is not None:
            self._guarded(self._file.flush)

    def event(self, text: str) -> None:
        """Write an event to the open file, if any."""
        if self._file is not None:
            self._guarded(self._file.file.event, text, time.time_ns())

    def close(self) -> None:
        self._is_unsure = False
        self.write()
        self._finish()

    def end(self, why: str) -> None:
        """End the recording; no method may be called afterwards."""
        file, self._file, self.wants, self.failed = self._file, None, False, why
        self._tell(f"{self.name}: recording ended: {why}")
        if file is not None:
            file.abandon()

    def _give_up(self) -> None:
        """Give up waiting for a description and drop the waiting rows; rows with the known schema belong to the same
        run."""
        self.wants, self._since = False, None
        if self._is_unsure:
            self._is_unsure = False
            return
        self._refuse("rows without a description", len(self._waiting))
        self._waiting.clear()

    def _sorted(self, run: _BridgeRun, row: bytes, packed: list[bytes]) -> list[bytes]:
        """Queue a row for writing; at a gap, write the earlier rows and record the gap."""
        tick = tick_of(row)
        if run.last is not None and tick <= run.last:
            self.late += 1
            return packed
        if run.last is not None and tick > run.last + 1:
            self._put(packed)
            packed = []
            self._hole(run.last + 1, tick - 1, stamp_of(row))
        self.last = run.last = tick
        run.stamp_ns = stamp_of(row)
        packed.append(row)
        return packed

    def _hole(self, first: int, last: int, stamp_ns: int) -> None:
        self.lost += last - first + 1
        text = f"{last - first + 1} rows missing, ticks {first} to {last}"
        self._tell(f"{self.name}: {text}")
        if self._open():
            file = self._file
            if file is not None:
                file.lost += last - first + 1
                file.holes.append((first, last, last - first + 1))
                self._guarded(file.file.event, text, stamp_ns)

    def _put(self, packed: list[bytes]) -> None:
        if packed and self._open() and self._file is not None and self._guarded(self._file.file.write, packed):
            self.rows += len(packed)
        elif packed:
            self.lost += len(packed)

    def _open(self) -> bool:
        """Open a file if none is open, and return whether one is open; after a failure, the next attempt is delayed."""
        run = self._run
        if self._file is None and run is not None and time.monotonic() >= self._retry:
            try:
                self._file = _RobotFile(self._path, run)
            except ArmlabError as error:
                self._fail(str(error))
            else:
                self.failed = None
                self.paths.append(self._file.file.path)
                self._tell(f"{self.name}: recording to {self._file.file.path}")
        return self._file is not None

    def _guarded(self, work: Callable[..., Any], *values: Any) -> bool:
        try:
            work(*values)
        except Exception as error:  # catches all errors: other robots continue
            reason = getattr(error, "strerror", None) or f"{type(error).__name__}: {error}"
            file, self._file = self._file, None
            if file is not None:
                file.abandon()
                self._fail(f"The log {file.file.path} stopped after {file.file.rows} rows: {reason}.")
            return False
        return True

    def _fail(self, why: str) -> None:
        if why != self.failed:
            self._tell(f"{self.name}: {why} Retrying in {_AGAIN:g} s.")
        self.failed, self._retry = why, time.monotonic() + _AGAIN

    def _finish(self) -> None:
        if self._file is not None:
            self._guarded(self._file.finish)
            self._file = None

    def _refuse(self, why: str, count: int = 1) -> None:
        if self.refused == 0 and count:
            self._tell(f"{self.name}: invalid messages: {why}")
        self.refused += count


class RowColumns:
    """Byte ranges of the recorded columns in a bridge's rows, which may lack some columns."""

    def __init__(self, schema: RowSchema, robot: str, layout: RowLayout) -> None:
        if f"{robot}.tick" not in schema.fields:
            raise LinkError(f"Expected rows with the ticks of {robot}, got ticks of {', '.join(schema.robots)}.")
        self._id, self._size = schema.id, schema.size
        self._places: list[slice | bytes] = []
        for name, slot in layout.slots.items():
            if name == SELDOM[0]:
                break  # rows may omit the remaining columns
            field = schema.fields.get(f"{robot}.{name}")
            if name == "stamp_ns":
                self._places.append(_WALL)
            elif field is None:
                self._places.append(slot.nothing)
            elif field.shape != slot.column.shape or field.type == "text":
                raise LinkError(f"Expected {field.name} of shape {slot.column.shape} in the rows, got {field.shape}.")
            else:  # for a flag, the lowest byte, in which -1 becomes 255 (missing)
                stop = field.offset + 8 * math.prod(field.shape)
                self._places.append(slice(field.offset, stop, 8 if slot.dtype == "u1" else None))

    def packed(self, data: bytes) -> bytes:
        """Convert a bridge row to a recording row; raise a LinkError if its schema differs."""
        if len(data) != self._size or data[:4] != MAGIC or data[8:16] != self._id:
            raise LinkError(f"Expected a row of {self._size} bytes and schema {self._id.hex()}, got {len(data)} bytes.")
        return b"".join([place if isinstance(place, bytes) else data[place] for place in self._places])


def stamp_of(packed: bytes) -> int:
    return _PAIR.unpack_from(packed)[0]


def tick_of(packed: bytes) -> int:
    return _PAIR.unpack_from(packed)[1]


class _BridgeRun:
    """Bridge run: its description, and the tick and timestamp of its last row."""

    def __init__(self, robot: str, about: bytes) -> None:
        said = read_about(about)
        self.id, self.schema, self.robot = said.run, said.schema, said.robots[robot]
        self.layout = RowLayout(self.robot)
        self.columns = RowColumns(self.schema, robot, self.layout)
        self.last: int | None = None  # tick
        self.stamp_ns = 0

    def has_restarted(self, row: bytes) -> bool:
        """Return whether the ticks decreased while time advanced, which indicates a bridge restart."""
        return self.last is not None and tick_of(row) <= self.last and stamp_of(row) > self.stamp_ns


class _RobotFile:
    """Output file of one robot, with its counts and gaps."""

    def __init__(self, path: Path, run: _BridgeRun) -> None:
        self.file = RecordingFile(path, run.robot, run.layout, {}, "")
        self.holes: deque[tuple[int, int, int]] = deque(maxlen=_MOST_HOLES)
        self.lost = self.damaged = 0
        self._syncing = Syncing(self.file.to_disk, f"sync {path.name}")

    def flush(self) -> None:
        self.file.close_chunk()
        self._syncing.ask()

    def finish(self) -> None:
        self._syncing.close()
        counted = {"rows": self.file.rows, "dropped": self.lost, "damaged": self.damaged}
        self.file.finish({**counted, "holes": list(self.holes)})

    def abandon(self) -> None:
        self.file.abandon()
        with contextlib.suppress(OSError):  # already reported
            self._syncing.close()
