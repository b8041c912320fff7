"""Zenoh messages: keys, attachments, text messages, rows with checksums, and the inbox of a client."""

from __future__ import annotations

import struct
import threading
import zlib
from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any, Generic, NamedTuple, TypeVar

import msgspec

from armlab.bridge.servers.row import LARGEST, RowSchema
from armlab.errors import CommandRefused, LinkError
from armlab.robots import Robot, from_toml

EVERY = "*"
"""Wildcard for labs or robots in a key."""

COMMANDS = {"position": "q", "velocity": "qd", "effort": "tau", "motion": "q qd"}
"""Fields of a command (n numbers each) by the last word of its key; "motion": positions, then velocities."""

_ATTACHED = struct.Struct("<16sqq")


def key(lab: str, robot: str, what: str) -> str:
    return f"armlab/{lab}/{robot}/{what}"


def robot_of(name: str) -> tuple[str, str]:
    _, lab, robot, *_ = name.split("/")
    return lab, robot


class Attachment(NamedTuple):
    """Attachment of a command or setting: 32 bytes, little-endian."""

    sender: bytes
    seq: int
    stamp_ns: int

    def pack(self) -> bytes:
        return _ATTACHED.pack(*self)

    @classmethod
    def read(cls, data: bytes | None) -> Attachment:
        if data is None or len(data) != _ATTACHED.size:
            got = "none" if data is None else f"{len(data)} bytes"
            raise CommandRefused(
                f"Expected an attachment of {_ATTACHED.size} bytes (16-byte id, int64 number, int64 ns), got {got}."
            )
        return cls(*_ATTACHED.unpack(data))

    @property
    def client(self) -> str:
        """Complete, unique sender id in hexadecimal."""
        return self.sender.hex()


def data_of(part: Any) -> bytes | None:
    """Return the bytes of a payload or an attachment, or None if it is absent."""
    return None if part is None else part.to_bytes()


_LARGEST = 2**17  # maximum size of a message from the loop in bytes; a reply to "about" contains at most three messages
_Count = Annotated[int, msgspec.Meta(ge=-(2**63), le=2**63 - 1)]


class _About(msgspec.Struct, tag_field="kind", tag="about"):
    schema: str
    robots: dict[str, str]
    run: str = ""
    cell: str = ""


class _Parameters(msgspec.Struct, tag_field="kind", tag="parameters"):
    parameters: list[dict[str, Any]]


class _Recording(msgspec.Struct, tag_field="kind", tag="recording"):
    files: list[str]


class _Event(msgspec.Struct, tag_field="kind", tag="event"):
    stamp_ns: _Count
    text: str


class _ArmStatus(msgspec.Struct):
    rate: float | None = None
    p50: float | None = None
    p99: float | None = None
    longest: float | None = None
    missed: _Count = 0
    late: _Count = 0
    drops: _Count = 0
    clamps: dict[str, list[_Count]] = {}


class _Status(msgspec.Struct, tag_field="kind", tag="status"):
    arms: dict[str, _ArmStatus]
    lost: _Count = 0


_Text = _Parameters | _Recording | _Event | _Status


class About(NamedTuple):
    """Bridge reply to the query "about"."""

    messages: list[dict[str, Any]]
    schema: RowSchema
    robots: Mapping[str, Robot]
    run: str
    cell: str


def read_about(data: bytes) -> About:
    """Decode and check the reply of a bridge to the query "about"."""
    messages = _converted(_decoded(data, 3 * _LARGEST), list[dict[str, Any]])
    about = _converted(messages[0] if messages else {}, _About)
    for one in messages[1:]:
        _converted(one, _Text)
    schema = RowSchema.read(about.schema.encode())
    if set(about.robots) != set(schema.robots):
        raise LinkError(
            f"Expected descriptions of all arms in the rows, {', '.join(schema.robots)[:200]}, got "
            f"{', '.join(about.robots)[:200] or 'none'}. Install the same version of armlab at both ends."
        )
    robots = {name: replace(from_toml(text, f"the bridge of {name}"), name=name) for name, text in about.robots.items()}
    for robot in robots.values():
        schema.require(robot, whole=False)
    for field in schema.fields.values():  # `Watch` identifies the arms by these fields
        if field.type == "text" and field.name.removesuffix(".commander") not in robots:
            raise LinkError(f"Expected the commander fields to be the only text fields in rows, got {field.name[:60]}.")
    return About([{**messages[0], "kind": "about"}, *messages[1:]], schema, robots, about.run, about.cell)


def read_message(data: bytes) -> dict[str, Any]:
    """Decode and check a message from the keys "events", "status" and "parameters"."""
    message = _decoded(data, _LARGEST)
    _converted(message, _Text)
    return message


def _decoded(data: bytes, largest: int) -> Any:
    if len(data) > largest:
        raise LinkError(f"Expected a bridge message of at most {largest} bytes, got {len(data)}.")
    try:
        return msgspec.json.decode(data)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise LinkError(f"Expected a bridge message in JSON, got invalid data ({str(error).rstrip('.')}).") from None


def _converted(value: Any, type: Any) -> Any:
    try:
        return msgspec.convert(value, type)
    except msgspec.ValidationError as error:
        raise LinkError(f"Expected a bridge message, got an invalid one ({str(error)[:200].rstrip('.')}).") from None


_MOST = 2**26  # bytes in an inbox: ten seconds of rows from twenty arms at the full rate
_LEAST = 256  # bytes: minimum nominal size of a message

T = TypeVar("T")


class Inbox(Generic[T]):
    """Queue of messages from Zenoh threads; when full, it drops the oldest messages."""

    def __init__(self, most: int) -> None:
        self._most, self._size = most, 0
        self._waiting: deque[tuple[int, T]] = deque()
        self._arrived = threading.Condition(threading.Lock())

    def __len__(self) -> int:
        return len(self._waiting)

    def put(self, message: T, size: int = 0) -> None:
        size = max(size, _LEAST)
        with self._arrived:
            while self._waiting and (len(self._waiting) >= self._most or self._size + size > _MOST):
                self._size -= self._waiting.popleft()[0]
            self._waiting.append((size, message))
            self._size += size
            self._arrived.notify()

    def get(self, patience: float = 0.0) -> T | None:
        """Remove and return the oldest message, or None if none arrives in time."""
        with self._arrived:
            if not self._waiting and not (patience > 0.0 and self._arrived.wait(patience) and self._waiting):
                return None
            size, message = self._waiting.popleft()
            self._size -= size
            return message

    def wait(self, patience: float) -> bool:
        """Return whether a message is available within this time [s]."""
        with self._arrived:
            return bool(self._waiting) or self._arrived.wait(patience)


_NUMBER = struct.Struct("<q")


class Gaps:
    """Counts missing rows for a subscriber to all rows of an arm (keys "state" and "live")."""

    rows: int = 0
    lost: int = 0
    starts: int = 0

    def __init__(self, schema: RowSchema, robot: str) -> None:
        self._at = schema.fields[f"{robot}.tick"].offset
        self._last = -1

    def take(self, data: bytes) -> int:
        """Count a row; return the number of rows missing before it."""
        (number,) = _NUMBER.unpack_from(data, self._at)
        if number <= self._last or not self.rows:  # a new run
            self.starts += 1
            missing = 0
        else:
            missing = number - self._last - 1
        self._last = number
        self.rows += 1
        self.lost += missing
        return missing


_SUM = struct.Struct("<I")


def checksum(data: bytes) -> bytes:
    """Return the CRC-32 of a row (4 bytes, little-endian). Reference: ISO 3309, the CRC-32 of zlib and Ethernet."""
    return _SUM.pack(zlib.crc32(data))


def undamaged(sample: Any) -> bytes | None:
    """Return the row in a sample, or None if it is too large or its checksum is wrong or missing."""
    data = sample.payload.to_bytes()
    return data if len(data) <= LARGEST and data_of(sample.attachment) == checksum(data) else None
