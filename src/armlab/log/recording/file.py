"""MCAP file of a recording; it never replaces an existing file and, after a crash, is complete up to the last row."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from armlab import __version__
from armlab._files import Descriptor, apart
from armlab.errors import ConfigError, LogError
from armlab.kernels import RowEncoder
from armlab.log.mcap.writer import McapWriter
from armlab.log.recording import ros_messages as ros
from armlab.log.recording.metadata import attached, metadata
from armlab.log.recording.rows import RowLayout
from armlab.robots import Robot

_FLAGS = os.O_WRONLY | getattr(os, "O_CLOEXEC", 0)


class PersistentFile:
    """New file, opened for unbuffered writing.

    If other code closes the file descriptor, the file is reopened by its path, and writing continues at the same
    position.
    """

    def __init__(self, path: str | Path) -> None:
        self.name: str = str(Path(path).absolute())
        self.closed = False
        self._at = 0
        self._lock = threading.Lock()  # the writing and syncing threads may both find the descriptor closed
        self._descriptor = Descriptor(os.open(self.name, _FLAGS | os.O_CREAT | os.O_EXCL, 0o666))

    def fileno(self) -> int:
        """Return the file descriptor, which may change."""
        with self._lock:
            if self.closed:
                raise OSError(errno.EBADF, os.strerror(errno.EBADF))
            if not self._descriptor.is_open:
                self._descriptor = self._reopened()
            return self._descriptor.number

    def write(self, data: bytes | bytearray | memoryview) -> int:
        done = os.write(self.fileno(), data)
        self._at += done
        return done

    def seek(self, at: int) -> int:
        self._at = os.lseek(self.fileno(), at, os.SEEK_SET)
        return self._at

    def truncate(self, size: int) -> int:
        os.ftruncate(self.fileno(), size)
        return size

    def close(self) -> None:
        with self._lock:
            self._descriptor.close()
            self.closed = True

    def _reopened(self) -> Descriptor:
        number = apart(os.open(self.name, _FLAGS))
        if not self._descriptor.same_file(number):
            os.close(number)
            raise FileNotFoundError(errno.ENOENT, "its descriptor was closed, and its name belongs to another file")
        os.lseek(number, self._at, os.SEEK_SET)
        return Descriptor(number)


MAX_CHUNK_ROWS = 250  # one second at 250 Hz, the maximum loss from a corrupt chunk, even after a stall
_EVENT_TYPE = "rcl_interfaces/msg/Log"
_PARAMETER_TYPE = "armlab_msgs/msg/Parameter"


def recording_path(path: str | Path) -> Path:
    """Return the path of a recording after checking its extension."""
    path = Path(path)
    if path.suffix.lower() != ".mcap":
        raise ConfigError(
            f"Expected a recording name with the extension .mcap, got {path}. Change the extension; armlab log export "
            "and log.write create files in other formats."
        )
    return path


def open_new(path: str | Path) -> tuple[PersistentFile, Path]:
    """Open a new file ``run.mcap``, or ``run-2.mcap``, ... if that name exists; return the file and its path."""
    path = Path(path)
    number, candidate = 1, path
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        while True:
            try:
                return PersistentFile(candidate), candidate
            except FileExistsError:
                number += 1
                candidate = path.with_name(f"{path.stem}-{number}{path.suffix}")
    except OSError as error:
        raise LogError(f"Expected to create the log {candidate}, got: {error.strerror}.") from None


class RecordingFile:
    """Recording of one arm: an MCAP file (profile ros2, zstd), created by the constructor.

    `clock`: for a layout with a column `t`, the wall-clock time at t = 0 [ns] and the clock name.
    """

    def __init__(
        self,
        path: str | Path,
        robot: Robot,
        layout: RowLayout,
        attachments: Mapping[str, bytes],
        note: str,
        clock: tuple[int, str] | None = None,
    ) -> None:
        self._file, self.path = open_new(path)
        self._layout, self._clock = layout, clock
        self._chunk_rows = 0
        self.rows: int = 0
        self.last_stamp_ns: int = time.time_ns()
        try:
            self._writer = McapWriter(self._file, "ros2", f"armlab {__version__}")
            attachments = attached(robot, attachments)
            self._writer.metadata("armlab", metadata(robot, attachments, note))
            for name, data in attachments.items():
                self.attach(name, data)
            self._encoder = RowEncoder(self._register(robot))
            self._opening = f"recording {robot.name}"  # an event, with the stamp of the first message
            self.sync()
        except OSError as error:
            self.abandon()
            raise LogError(f"Expected to write the log {self.path}, got: {error.strerror}.") from None

    def _register(self, robot: Robot) -> list[ros.Plan]:
        """Register all schemas and channels, and return the encoding plans of the row messages."""

        def channel(name: str, message_type: str, metadata: dict[str, str]) -> int:
            schema = self._writer.schema(message_type, "ros2msg", ros.definition(message_type).encode())
            topic = f"/{ros.topic_name(robot.name)}/{name}"
            return self._writer.channel(topic, "cdr", schema, metadata)

        self._events = channel("events", _EVENT_TYPE, {})
        slots, plans = self._layout.slots, []
        for topic in ros.topics(self._layout, robot.ros_joint_names):
            clock = ros.clock_metadata(*self._clock) if self._clock and "t" in topic.fields else {}
            number = channel(topic.name, topic.type, topic.metadata(slots) | clock)
            plans.append(ros.plan(number, topic, slots))
        self._parameters = channel("parameters", _PARAMETER_TYPE, {})
        return plans

    def write(self, rows: Sequence[bytes], first: int | None = None) -> None:
        """Write the messages of rows, numbered from `first` or by tick; the messages survive a process crash."""
        if self._opening and rows:
            self._open(_stamp(rows[0]))
        at = 0
        while at < len(rows):
            some = rows[at : at + MAX_CHUNK_ROWS - self._chunk_rows]
            self._writer.records(*self._encoder.encode(some, None if first is None else first + at, self._writer.size))
            self._writer.push()
            at += len(some)
            self._chunk_rows += len(some)
            self.last_stamp_ns = _stamp(some[-1])
            self.rows += len(some)
            if self._chunk_rows >= MAX_CHUNK_ROWS:
                self.close_chunk()

    def event(self, text: str, stamp_ns: int) -> None:
        if self._opening:
            self._open(stamp_ns)
        self._writer.message(self._events, 0, stamp_ns, stamp_ns, ros.event(stamp_ns, text))
        self._writer.push()

    def _open(self, stamp_ns: int) -> None:
        text, self._opening = self._opening, ""
        self.event(text, stamp_ns)

    def parameter(self, sequence: int, name: str, value: Any, who: str, stamp_ns: int) -> None:
        data = ros.parameter(stamp_ns, sequence, name, value, who)
        self._writer.message(self._parameters, sequence & 0xFFFFFFFF, stamp_ns, stamp_ns, data)
        self._writer.push()

    def attach(self, name: str, data: bytes) -> None:
        media = "application/json" if name.endswith(".json") else "application/octet-stream"
        self._writer.attach(self.last_stamp_ns, name, media, data)

    def to_disk(self) -> None:
        """Sync everything to disk, unless the file is closed. Thread-safe."""
        if not self._file.closed:
            os.fsync(self._file.fileno())

    def sync(self) -> None:
        """Close the chunk and sync everything to disk, so all rows so far survive a power loss."""
        self.close_chunk()
        os.fsync(self._file.fileno())

    def finish(self, summary: Mapping[str, Any]) -> None:
        """Write the summary and the footer, sync the file and its folder to disk, and close."""
        if self._opening:
            self._open(self.last_stamp_ns)
        self.close_chunk()
        self.attach("summary.json", json.dumps(summary, indent=1, default=_plain).encode())
        self._writer.finish()
        os.fsync(self._file.fileno())
        self._file.close()
        with contextlib.suppress(OSError):
            folder = os.open(self.path.parent, os.O_RDONLY)
            os.fsync(folder)
            os.close(folder)

    def abandon(self) -> None:
        with contextlib.suppress(OSError):
            self._file.close()

    def close_chunk(self) -> None:
        """Finish the current chunk so that other programs can read it."""
        self._writer.close_chunk()
        self._chunk_rows = 0


def _stamp(row: bytes) -> int:
    return int.from_bytes(row[:8], "little", signed=True)


def _plain(value: Any) -> Any:
    """Convert NumPy values to plain Python for JSON."""
    return value.tolist() if hasattr(value, "tolist") else str(value)
