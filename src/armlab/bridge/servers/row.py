"""Binary rows for other programs: `RowSchema` defines the fields, `RowWriter` packs a row, `read_row` unpacks it.

A row is little-endian: "ALR1", the row length (uint32), the schema id (8 bytes), the row number (uint64), monotonic and
wall clock (int64 ns), and the fields, each at a multiple of 8 bytes. A row is at most 8 KiB long. The schema is
canonical JSON; its id is the first 8 bytes of its SHA-256 hash.
"""

from __future__ import annotations

import hashlib
import json
import math
import struct
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np

from armlab.errors import ConfigError, LinkError, UnknownName
from armlab.kernels import RowPacker
from armlab.log import Column, Tick
from armlab.log.column import resolved
from armlab.log.recording.rows import COUNTS, ESTIMATE, FIXED, FLAGS, JOINTS, REALS
from armlab.robots import Robot
from armlab.state import Command, State
from armlab.wire.egm import Drop, Packet

VERSION = 1
HEAD = struct.Struct("<4sI8sQqq")
TYPES = {"float64": "<f8", "int64": "<i8", "text": "S1"}
WORDS = 48  # maximum length of a commander's name in bytes: server, space, 16 hexadecimal digits
NOT_SENT = ("stamp_ns", "wake_ns")  # the row header contains stamp_ns


def _arm_columns() -> Iterator[tuple[str, str, str, str, tuple[int, ...] | None]]:
    """Yield name, type, source, form (see `kernels.RowPacker`) and shape (None: per joint) of an arm's fields."""
    yield from ((name, "float64", source, "real", ()) for name, source in REALS.items())
    yield "age", "float64", "", "blank", ()
    for name, source in JOINTS.items():
        yield name, "float64", source, "doubles" if source.startswith("tick.") else "fitting", None
    for name, (source, form, shape) in FIXED.items():
        yield name, "float64", source, "padded" if form == "padded" else "fitting", shape
    yield from ((name, "float64", f"record.{name}", "fitting", column.shape) for name, column in ESTIMATE.items())
    yield from ((name, "int64", source, "count", ()) for name, source in COUNTS.items() if name not in NOT_SENT)
    yield from ((name, "int64", source, "flag", ()) for name, source in FLAGS.items())
    yield "fresh", "int64", "", "blank", ()
    yield "clamped", "int64", "tick.clamped", "wide", None
    yield "commander", "text", "", "blank", (WORDS,)


UNITS = {"age": "s", "fresh": "1", "commander": "1"}


LARGEST = 8192
"""Maximum size of a row [bytes]."""


@dataclass(frozen=True, slots=True)
class RowField:
    """Field of a row."""

    name: str  # for example "yumi_left.q"
    type: str  # "float64", "int64", or "text" (UTF-8, padded with zero bytes)
    shape: tuple[int, ...]  # for text, the number of bytes
    unit: str  # as in the glossary
    frame: str  # as in the glossary
    labels: tuple[str, ...]  # along the first axis
    source: str  # robot or source
    offset: int  # from the beginning of the row [bytes]

    @property
    def size(self) -> int:
        """Size in bytes, padded to a multiple of 8."""
        count = math.prod(self.shape)
        return -(-count // 8) * 8 if self.type == "text" else 8 * count


class RowSchema:
    """Schema of a run's rows: robots, fields by name, canonical JSON `text` with its `id`, `size` in bytes."""

    size: int

    def __init__(self, robots: Sequence[str], fields: Iterable[RowField]) -> None:
        self.robots: tuple[str, ...] = tuple(robots)
        found = list(fields)
        self.fields: Mapping[str, RowField] = {field.name: field for field in found}
        self.size = HEAD.size
        for field in found:
            if field.type not in TYPES or field.offset != self.size or any(size < 0 for size in field.shape):
                raise ConfigError(f"Expected contiguous fields of known types in a row, got {str(field)[:200]}.")
            self.size += field.size
            if self.size > LARGEST:
                raise ConfigError(f"Expected rows of at most {LARGEST} bytes, got {self.size} with {field.name[:60]}.")
        if len(self.fields) < len(found):
            raise ConfigError("Expected each field of a row exactly once, got duplicate names. Rename a source.")
        about = {"version": VERSION, "robots": self.robots, "fields": [asdict(field) for field in found]}
        self.text: bytes = json.dumps(about, sort_keys=True, separators=(",", ":"), ensure_ascii=False).encode()
        self.id: bytes = hashlib.sha256(self.text).digest()[:8]

    @classmethod
    def of(cls, robots: Sequence[Robot], sources: Mapping[str, Mapping[str, Column]] | None = None) -> RowSchema:
        """Return the schema of a cell: log columns, age and commander of each robot, followed by the sources."""
        fields: list[RowField] = []
        at = HEAD.size

        def add(owner: str, name: str, type_: str, column: Column, unit: str | None = None) -> None:
            nonlocal at
            known = resolved(column, name) if unit is None else column
            fields.append(
                RowField(
                    f"{owner}.{name}",
                    type_,
                    column.shape,
                    unit or known.unit or "1",
                    known.frame or "",
                    tuple(column.labels),
                    owner,
                    at,
                )
            )
            at += fields[-1].size

        for robot in robots:
            for name, type_, _, _, shape in _arm_columns():
                column = Column((robot.n,), labels=robot.joint_names) if shape is None else Column(shape)
                add(robot.name, name, type_, column, UNITS.get(name))
        for source, columns in (sources or {}).items():
            for name, column in columns.items():
                add(source, name, "float64", column)
            add(source, "age", "float64", Column(), "s")
        return cls([robot.name for robot in robots], fields)

    def require(self, robot: Robot, *, whole: bool = True) -> None:
        """Raise an error unless the rows contain the fields of this arm that readers need."""
        for name, wanted in RowSchema.of([robot]).fields.items():
            found = self.fields.get(name, None if whole else wanted)
            if found is None or (found.type, found.shape) != (wanted.type, wanted.shape):
                got = "none" if found is None else f"{found.type} of shape {found.shape}"
                raise LinkError(
                    f"Expected rows with {name}, {wanted.type} of shape {wanted.shape}, got {got}. Use the same "
                    f"description of {robot.name} and the same version of armlab at both ends."
                )

    @classmethod
    def read(cls, text: bytes) -> RowSchema:
        import msgspec

        class Written(msgspec.Struct, forbid_unknown_fields=True):
            version: int
            robots: list[str]
            fields: list[RowField]

        try:
            written = msgspec.json.decode(text, type=Written)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            raise ConfigError(
                f"Expected the row schema as valid JSON, got {error}. Use the schema from the same feed."
            ) from None
        if written.version != VERSION:
            raise ConfigError(
                f"Expected rows of version {VERSION}, got {written.version}. Install the same version of armlab."
            )
        return cls(written.robots, written.fields)


MAGIC = b"ALR1"

MONO, WALL = HEAD.size - 16, HEAD.size - 8
"""Offsets of the clocks in a row, int64 [ns]."""

_BEGINNING = 16  # bytes before the row number
_LETTERS = {"float64": "d", "int64": "q"}  # format characters of `struct`


class Row(NamedTuple):
    """Unpacked row."""

    seq: int
    mono_ns: int  # monotonic clock
    wall_ns: int  # wall clock
    values: Mapping[str, Any]  # read-only arrays, numbers and strings by field name; unpacked on access


class _Values(Mapping[str, Any]):
    """Values of a row, unpacked on access, because a reader of 500 rows/s needs only a few of the hundred fields."""

    __slots__ = ("_data", "_fields")

    def __init__(self, fields: Mapping[str, RowField], data: bytes) -> None:
        self._fields, self._data = fields, data

    def __getitem__(self, name: str) -> Any:
        field = self._fields[name]
        if field.type == "text":
            raw = self._data[field.offset : field.offset + math.prod(field.shape)]
            return raw.rstrip(b"\0").decode(errors="replace")
        array = np.frombuffer(self._data, TYPES[field.type], math.prod(field.shape), field.offset)
        return array.reshape(field.shape) if field.shape else array[0].item()

    def __iter__(self) -> Iterator[str]:
        return iter(self._fields)

    def __len__(self) -> int:
        return len(self._fields)


def read_row(schema: RowSchema, data: bytes) -> Row:
    return Row(*read_head(schema, data), _Values(schema.fields, data))


def read_head(schema: RowSchema, data: bytes) -> tuple[int, int, int]:
    """Return the number, the monotonic time and the wall-clock time [ns] of a row."""
    if len(data) < HEAD.size or data[:4] != MAGIC:
        raise LinkError(f"Expected a row that begins with {MAGIC.decode()}, got {len(data)} bytes: {data[:8]!r}.")
    _, size, id_, seq, mono_ns, wall_ns = HEAD.unpack_from(data)
    if id_ != schema.id:
        raise LinkError(f"Expected a row of schema {schema.id.hex()}, got {id_.hex()}. Read the new schema first.")
    if size != len(data) or size != schema.size:
        raise LinkError(f"Expected a row of {schema.size} bytes, got {len(data)} with a stated size of {size}.")
    return seq, mono_ns, wall_ns


def beginning(schema: RowSchema) -> bytes:
    """Return the leading bytes, which are the same in all rows of a schema."""
    return HEAD.pack(MAGIC, schema.size, schema.id, 0, 0, 0)[:_BEGINNING]


def clock_ms(robot_ns: int, session_t: float) -> int | None:
    """Return the robot clock [ms] if it is set, otherwise the session clock; None for an invalid session clock."""
    if robot_ns:
        return robot_ns // 10**6
    ms = 1e3 * session_t
    return round(ms) if math.isfinite(ms) else None


def places(schema: RowSchema, source: str) -> dict[str, tuple[struct.Struct, int]]:
    """Return the format and offset of each numeric field of a source, for unpacking selected fields quickly."""
    return {
        field.name.removeprefix(f"{source}."): (
            struct.Struct(f"<{math.prod(field.shape)}{_LETTERS[field.type]}"),
            field.offset,
        )
        for field in schema.fields.values()
        if field.source == source and field.type in _LETTERS
    }


class _Part:
    """Offsets of one arm's fields in a row, and their packer."""

    def __init__(self, schema: RowSchema, robot: str) -> None:
        fields = {name: schema.fields[f"{robot}.{name}"] for name, *_ in _arm_columns()}
        self.start, self.commander = fields["session_t"].offset, fields["commander"].offset
        self.stop = self.commander + fields["commander"].size
        self.age, self.fresh = ((fields[name].offset - HEAD.size) // 8 for name in ("age", "fresh"))
        self.received_ns = 0
        places = []
        for name, type_, source, form, _ in _arm_columns():
            value = {"age": 0.0, "fresh": 1}.get(name, np.nan if type_ == "float64" else 0)
            nothing = np.full(fields[name].size // 8, value, TYPES.get(type_) if type_ != "text" else "<i8").tobytes()
            owner, _, attribute = source.partition(".")
            places.append((name, owner or "state", attribute, form, nothing, None))
        self.pack = RowPacker((State, Command, Tick), places, "").pack


class RowWriter:
    """Packs the rows of a run, arm by arm."""

    def __init__(self, schema: RowSchema) -> None:
        self._schema, self._seq = schema, 0
        self._buffer = bytearray(schema.size)
        self._numbers = np.frombuffer(self._buffer, "<f8", offset=HEAD.size)
        self._integers = np.frombuffer(self._buffer, "<i8", offset=HEAD.size)
        for field in schema.fields.values():
            if field.type == "float64":
                start = (field.offset - HEAD.size) // 8
                self._numbers[start : start + field.size // 8] = np.inf if field.name.endswith(".age") else np.nan
        self._parts = {robot: _Part(schema, robot) for robot in schema.robots}
        self._sources = [field for field in schema.fields.values() if field.source not in schema.robots]

    def row(self, state: State, command: Command | None, tick: Tick, mono_ns: int, commander: str = "") -> bytes:
        """Return the row after a tick of one arm, with the last values and ages of the other arms."""
        part = self._parts.get(state.robot)
        if part is None:
            raise UnknownName.among("robot of these rows", state.robot, self._parts)
        self._seq += 1
        buffer = self._buffer
        HEAD.pack_into(buffer, 0, MAGIC, len(buffer), self._schema.id, self._seq, mono_ns, tick.stamp_ns)
        buffer[part.start : part.stop] = part.pack(state, command, tick)
        word = commander.encode(errors="replace")[:WORDS]
        buffer[part.commander : part.commander + WORDS] = word + bytes(WORDS - len(word))
        part.received_ns = tick.receive_ns
        for other in self._parts.values():
            if other is not part and other.received_ns:
                self._numbers[other.age] = 1e-9 * (tick.receive_ns - other.received_ns)
                self._integers[other.fresh] = 0
        if self._sources:
            self._fill_sources(state)
        return bytes(buffer)

    def _fill_sources(self, state: State) -> None:
        """Write the last values of each source, regardless of their age."""
        for field in self._sources:
            held = state.sources.get(field.source)
            if held is not None:
                name, start = field.name.removeprefix(f"{field.source}."), (field.offset - HEAD.size) // 8
                values = held.age if name == "age" else held.kept[name]
                self._numbers[start : start + field.size // 8] = np.ravel(values)


class RowsAsPackets:
    """Base class of codecs for links that carry rows instead of EGM packets; see `wire.egm.Codec`."""

    def __init__(self) -> None:
        self.capabilities: frozenset[str] = frozenset({"position", "velocity"})

    def reset(self) -> None:
        """Do nothing, because rows are self-contained."""

    def _packet(self, q: np.ndarray, qd: np.ndarray, tau: np.ndarray, **fields: Any) -> Packet | Drop:
        if not np.isfinite(q).all():
            return Drop("not finite", "the positions of a row")
        has_tau = bool(np.isfinite(tau).all())
        return Packet(
            q=q,
            qd=qd if np.isfinite(qd).all() else None,
            tau=tau if has_tau else None,
            tau_source="measured" if has_tau else "none",
            robotware="unknown",
            rapid_data=_NOTHING,
            rapid_digital=False,
            robot_mono_ns=0,
            queue_depth=-1,
            **fields,
        )


_NOTHING = np.zeros(0)
_NOTHING.flags.writeable = False


class Pace:
    """Rate limit of rows per arm; a row is accepted if any arm that it updates is due."""

    def __init__(self, every: float) -> None:
        self._every = every
        self._due: dict[Hashable, float] = {}

    def takes(self, arms: Iterable[Hashable], now: float) -> bool:
        """Return whether a row is due for any of these arms."""
        due = [arm for arm in arms if now >= self._due.get(arm, now)]
        for arm in due:
            self._due[arm] = max(self._due.get(arm, now) + self._every, now)
        return bool(due)
