"""Rows as bytes for other programs: `RowWriter` fills one, `read_row` takes it apart. `RowSchema` says what is in it.

A row is little-endian: "ALR1", its length (uint32), the schema's id (8 bytes), its number (uint64), monotonic and wall
clock (int64 ns), then the fields, each at a multiple of 8 bytes, at most 8 KiB together. The schema is canonical JSON;
its id is the first 8 bytes of its SHA-256.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from armlab.bridge._row_layout import ASKED, COUNTS, FIXED, HEAD, MEASURED, REALS, RECORDED, SENT, TYPES, WORDS
from armlab.bridge.row_schema import RowField, RowSchema
from armlab.errors import LinkError, UnknownName
from armlab.log import Tick
from armlab.state import Command, State

__all__ = ["MAGIC", "MONO", "WALL", "Row", "RowWriter", "beginning", "clock_ms", "places", "read_head", "read_row"]

MAGIC = b"ALR1"

MONO, WALL = HEAD.size - 16, HEAD.size - 8
"""Places of the clocks in a row, int64 [ns]."""

_BEGINNING = 16  # bytes until the number of the row
_LETTERS = {"float64": "d", "int64": "q"}  # of `struct`


class Row(NamedTuple):
    """One row taken apart.

    Attributes
    ----------
    seq : its number. mono_ns, wall_ns : when it was made. values : read-only arrays, numbers and texts by field name;
        each is taken out of the bytes when it is asked for.
    """

    seq: int
    mono_ns: int
    wall_ns: int
    values: Mapping[str, Any]


class _Values(Mapping[str, Any]):
    """The values in a row: who wants three of a hundred fields at 500 rows a second pays for three."""

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
    """Return the row in `data`.

    Parameters
    ----------
    schema : of the feed. data : one message.

    Raises
    ------
    LinkError : no row, one of another schema, or of another length.
    """
    return Row(*read_head(schema, data), _Values(schema.fields, data))


def read_head(schema: RowSchema, data: bytes) -> tuple[int, int, int]:
    """Return number, monotonic and wall clock [ns] of a row.

    Parameters
    ----------
    schema, data : as of `read_row`.

    Raises
    ------
    LinkError : as of `read_row`.
    """
    if len(data) < HEAD.size or data[:4] != MAGIC:
        raise LinkError(f"Expected a row that begins with {MAGIC.decode()}, got {len(data)} bytes: {data[:8]!r}.")
    _, size, id_, seq, mono_ns, wall_ns = HEAD.unpack_from(data)
    if id_ != schema.id:
        raise LinkError(f"Expected a row of schema {schema.id.hex()}, got {id_.hex()}. Read the new schema first.")
    if size != len(data) or size != schema.size:
        raise LinkError(f"Expected a row of {schema.size} bytes, got {len(data)} that say {size}. Read whole messages.")
    return seq, mono_ns, wall_ns


def beginning(schema: RowSchema) -> bytes:
    """Return what all rows of a schema begin with.

    Parameters
    ----------
    schema : of the rows.
    """
    return HEAD.pack(MAGIC, schema.size, schema.id, 0, 0, 0)[:_BEGINNING]


def clock_ms(robot_ns: int, session_t: float) -> int | None:
    """Return the clock of a robot [ms], that of its session where it tells none; None where neither is a time.

    Parameters
    ----------
    robot_ns, session_t : of a row [ns, s].
    """
    if robot_ns:
        return robot_ns // 10**6
    ms = 1e3 * session_t
    return round(ms) if math.isfinite(ms) else None


def places(schema: RowSchema, source: str) -> dict[str, tuple[struct.Struct, int]]:
    """Return where the numbers of a source are in its rows: their form and their offset, by field without the source.

    Who wants the same few fields of every row reads them at a tenth of the time.

    Parameters
    ----------
    schema : of the rows. source : robot or source.
    """
    return {
        field.name.removeprefix(f"{source}."): (
            struct.Struct(f"<{math.prod(field.shape)}{_LETTERS[field.type]}"),
            field.offset,
        )
        for field in schema.fields.values()
        if field.source == source and field.type in _LETTERS
    }


class _Part:
    """Where the values of one robot are in the row, as indices of 8 bytes."""

    def __init__(self, schema: RowSchema, robot: str) -> None:
        def place(name: str) -> slice:
            field = schema.fields[f"{robot}.{name}"]
            start = (field.offset - HEAD.size) // 8
            return slice(start, start + field.size // 8)

        self.n = schema.fields[f"{robot}.q"].shape[0]
        self.reals = schema.fields[f"{robot}.{REALS[0]}"].offset
        self.counts = schema.fields[f"{robot}.{COUNTS[0]}"].offset
        self.age, self.fresh = place("age").start, place("fresh").start
        self.measured = [(name, place(name)) for name in MEASURED]
        self.asked = [(place(name), attribute) for name, attribute in ASKED.items()]
        self.sent = [(name, place(name)) for name in SENT]
        self.fixed = [(name, place(name), math.prod(shape)) for name, shape in FIXED.items() if name != "q_ext"]
        self.q_ext, self.clamped = place("q_ext"), place("clamped")
        self.recorded = [(name, place(name), math.prod(shape)) for name, shape in RECORDED.items()]
        self.commander = schema.fields[f"{robot}.commander"].offset
        self.heard_ns = 0


class RowWriter:
    """Fills the row of a run, arm by arm.

    Parameters
    ----------
    schema : of the rows, made by `RowSchema.of`.
    """

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
        """Return the row after a tick of one arm; what the others gave last is in it too, with its age.

        Parameters
        ----------
        state, command, tick : see `recording.Feed`. mono_ns : our monotonic clock. commander : of this arm.

        Raises
        ------
        UnknownName : the robot of the state is not in the schema.
        """
        part = self._parts.get(state.robot)
        if part is None:
            raise UnknownName.among("robot of these rows", state.robot, self._parts)
        self._seq += 1
        buffer = self._buffer
        HEAD.pack_into(buffer, 0, MAGIC, len(buffer), self._schema.id, self._seq, mono_ns, tick.stamp_ns)
        struct.pack_into("<4d", buffer, part.reals, state.t, state.dt, state.utilization, 0.0)
        struct.pack_into(
            "<16q", buffer, part.counts, tick.number, state.seq, tick.seq_sent, state.session, state.missed, tick.drops,
            state.robot_ns, tick.receive_ns, tick.send_ns, tick.step_ns, state.motors, state.mci, state.rapid,
            state.converged, tick.late, 1,
        )  # fmt: skip
        self._fill(part, state, command, tick)
        word = commander.encode(errors="replace")[:WORDS]
        buffer[part.commander : part.commander + WORDS] = word + bytes(WORDS - len(word))
        part.heard_ns = tick.receive_ns
        for other in self._parts.values():
            if other is not part and other.heard_ns:
                self._numbers[other.age] = 1e-9 * (tick.receive_ns - other.heard_ns)
                self._integers[other.fresh] = 0
        if self._sources:
            self._fill_sources(state)
        return bytes(buffer)

    def _fill_sources(self, state: State) -> None:
        """Write what each source gave last, whatever its age."""
        for field in self._sources:
            held = state.sources.get(field.source)
            if held is not None:
                name, start = field.name.removeprefix(f"{field.source}."), (field.offset - HEAD.size) // 8
                values = held.age if name == "age" else held.kept[name]
                self._numbers[start : start + field.size // 8] = np.ravel(values)

    def _fill(self, part: _Part, state: State, command: Command | None, tick: Tick) -> None:
        numbers, n = self._numbers, part.n
        for name, place in part.measured:
            values = getattr(state, name)
            numbers[place] = values if len(values) == n else np.nan
        for place, attribute in part.asked:
            values = None if command is None else getattr(command, attribute)
            numbers[place] = np.nan if values is None or np.shape(values) != (n,) else values
        for name, place in part.sent:
            values = getattr(tick, name)
            numbers[place] = np.nan if values is None else values
        for name, place, size in part.fixed:
            values = getattr(state, name)
            numbers[place] = values.ravel() if values.size == size else np.nan
        numbers[part.q_ext] = np.nan
        external = state.q_ext[: part.q_ext.stop - part.q_ext.start]
        numbers[part.q_ext.start : part.q_ext.start + len(external)] = external
        record = {} if command is None else command.record
        for name, place, size in part.recorded:
            values = record.get(name) if record else None
            numbers[place] = np.nan if values is None or np.size(values) != size else np.ravel(values)
        self._integers[part.clamped] = 0 if tick.clamped is None else tick.clamped
