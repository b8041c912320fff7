"""One row of a recording as bytes: packed in the loop in a few microseconds, taken apart elsewhere."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from armlab.errors import RobotError, ShapeError, UnknownName
from armlab.log.column import Column
from armlab.log.states import QD_SOURCES, TAU_SOURCES
from armlab.state import Command, State

if TYPE_CHECKING:
    from armlab.robots import Robot

__all__ = ["NO_CLOCK", "NO_COUNT", "NO_FLAG", "SELDOM", "RowLayout", "Slot", "Tick", "with_holes"]

# Marks of values that are not there, in counts and in flags. A clock that reads zero was not sent.
NO_COUNT, NO_CLOCK, NO_FLAG = -1, 0, 255

_COUNTS = (
    "stamp_ns", "tick", "seq", "seq_sent", "session", "missed", "drops", "robot_ns", "receive_ns", "send_ns",
    "step_ns", "motors", "mci", "rapid", "qd_source", "tau_source",
)  # fmt: skip
_REALS = ("session_t", "dt", "utilization")
_FLAGS = ("converged", "late")
_SCALARS = struct.Struct(f"<{len(_COUNTS)}q{len(_REALS)}d{len(_FLAGS)}?")
_JOINTS = ("q", "qd", "tau", "q_planned", "q_ref", "qd_ref", "tau_ref", "q_sent", "qd_sent", "tau_sent")
_FIXED = {"wrench_raw": (6,), "wrench": (6,), "T_frame_tool": (4, 4), "q_ext": (6,)}
_SELDOM = {
    "q_ext_ref": (6,), "q_ext_sent": (6,), "rapid_data": (40,), "rapid_data_sent": (40,), "rapid_digital": (),
    "rapid_digital_sent": (),
}  # fmt: skip
SELDOM = tuple(_SELDOM)
"""Columns of axes that are commanded and of values from and to RAPID: the end of a row, which most rows lack."""

# Compared by identity: asking NumPy to convert what needs no conversion takes as long as copying.
_F8, _U1 = np.dtype("<f8"), np.dtype("u1")
_ESTIMATE = {"wrench_hat": Column((6,)), "wrench_hat_cov": Column((6, 6))}
_QD_CODES = {name: code for code, name in enumerate(QD_SOURCES)}
_TAU_CODES = {name: code for code, name in enumerate(TAU_SOURCES)}


class Tick(NamedTuple):
    """What the bridge knows of one tick besides `State` and `Command`.

    Attributes
    ----------
    number : tick number of the bridge, increasing.
    seq_sent : sequence number of the reply, -1 when nothing was sent.
    stamp_ns : wall clock at start plus monotonic time since start, int64 nanoseconds.
    receive_ns, send_ns : arrival, and the moment before sending (-1 when nothing was sent).
    step_ns : time spent in the controller.
    late : the controller missed its deadline. drops : datagrams refused so far.
    q_sent, qd_sent, tau_sent : (n,) what went out after the limits, None when nothing did.
    clamped : (n,) bits of the limits that acted, None when there were none to apply.
    record : values of declared columns that the bridge knows, besides those of the Command.
    q_ext_sent, rapid_data_sent, rapid_digital_sent : what went to external axes and to RAPID, None for nothing.
    """

    number: int
    seq_sent: int
    stamp_ns: int
    receive_ns: int
    send_ns: int
    step_ns: int
    late: bool = False
    drops: int = 0
    q_sent: np.ndarray | None = None
    qd_sent: np.ndarray | None = None
    tau_sent: np.ndarray | None = None
    clamped: np.ndarray | None = None
    record: Mapping[str, Any] = MappingProxyType({})
    q_ext_sent: np.ndarray | None = None
    rapid_data_sent: np.ndarray | None = None
    rapid_digital_sent: bool | None = None


@dataclass(frozen=True, slots=True)
class Slot:
    """Where one column is in a row: bytes [start, stop) of type `dtype`; `missing` marks a value that is not there."""

    column: Column
    start: int
    stop: int
    dtype: str
    missing: int | None = None

    @property
    def size(self) -> int:
        """Number of values."""
        return (self.stop - self.start) // np.dtype(self.dtype).itemsize

    @property
    def nothing(self) -> bytes:
        """The bytes of a row that nothing was given for."""
        missing = np.nan if self.dtype == "<f8" else self.missing or 0
        return np.full(self.size, missing, self.dtype).tobytes()


class RowLayout:
    """Layout of the rows of one arm: the standard columns and the user's.

    Parameters
    ----------
    robot : gives the number and names of the joints.
    extra : the user's columns by name; `wrench_hat` and `wrench_hat_cov` need no declaration.

    Attributes
    ----------
    slots : name -> `Slot`. size : bytes of a row with all its parts. extra : the declared columns, resolved.

    Raises
    ------
    ShapeError, UnknownName : a declaration contradicts the glossary, lacks its unit, or repeats a standard column.
    RobotError : something else than a robot.
    """

    def __init__(self, robot: Robot, extra: Mapping[str, Column] | None = None) -> None:
        from armlab.robots import Robot

        if not isinstance(robot, Robot):
            raise RobotError.no_robot(robot)
        self.n = robot.n
        self.extra = {name: column.resolved(name) for name, column in {**_ESTIMATE, **(extra or {})}.items()}
        self.slots: dict[str, Slot] = {}
        self.size = 0
        self._add("stamp_ns", Column(unit="ns", kind="count"), "<i8")
        for name in _COUNTS[1:]:
            self._add(name, Column(), "<i8", NO_CLOCK if name in ("robot_ns", "receive_ns") else NO_COUNT)
        for name in _REALS:
            self._add(name, Column(), "<f8")
        for name in _FLAGS:
            self._add(name, Column(), "u1", NO_FLAG)
        for name in _JOINTS:
            self._add(name, Column((robot.n,), labels=robot.joint_names), "<f8")
        for name, shape in _FIXED.items():
            self._add(name, Column(shape), "<f8")
        for name, column in self.extra.items():
            if name in self.slots or column.kind == "text":
                raise ShapeError(f"Expected numeric columns with new names in `extra`, got {name!r} ({column.kind}).")
            self._add(name, column, "<f8")
        self._add("clamped", Column((robot.n,), labels=robot.joint_names), "u1", NO_FLAG)
        self._short = self.size
        for name, shape in _SELDOM.items():
            self._add(name, Column(shape), "<f8")
        self._nan = {name: slot.nothing for name, slot in self.slots.items()}
        self._extra = [(name, self._nan[name]) for name in self.extra]
        self._empty = b"".join(self._nan.values())

    def _add(self, name: str, column: Column, dtype: str, missing: int | None = None) -> None:
        column = column.resolved(name)
        stop = self.size + int(np.prod(column.shape, dtype=int)) * np.dtype(dtype).itemsize
        self.slots[name] = Slot(column, self.size, stop, dtype, missing)
        self.size = stop

    def pack(self, state: State, command: Command | None, tick: Tick) -> bytes:
        """Return one row as bytes. Values are copied; what is None or empty is NaN.

        Raises
        ------
        ShapeError : an array has the wrong number of values; names the column.
        """
        n, nan, none = self.n, self._nan, self._nan["q"]
        q_ref = qd_ref = tau_ref = None
        record = tick.record
        if command is not None:
            q_ref, qd_ref, tau_ref = command.q, command.qd, command.tau
            record = {**record, **command.record} if record else command.record
        parts = [
            _SCALARS.pack(
                tick.stamp_ns, tick.number, state.seq, tick.seq_sent, state.session, state.missed, tick.drops,
                state.robot_ns, tick.receive_ns, tick.send_ns, tick.step_ns, state.motors, state.mci, state.rapid,
                _QD_CODES.get(state.qd_source, 0), _TAU_CODES.get(state.tau_source, 0),
                state.t, state.dt, state.utilization, state.converged, tick.late,
            ),
            _raw("q", state.q, n, none),
            _raw("qd", state.qd, n, none),
            _raw("tau", state.tau, n, none),
            _raw("q_planned", state.q_planned, n, none),
            _raw("q_ref", q_ref, n, none),
            _raw("qd_ref", qd_ref, n, none),
            _raw("tau_ref", tau_ref, n, none),
            _raw("q_sent", tick.q_sent, n, none),
            _raw("qd_sent", tick.qd_sent, n, none),
            _raw("tau_sent", tick.tau_sent, n, none),
            _raw("wrench_raw", state.wrench_raw, 6, nan["wrench_raw"]),
            _raw("wrench", state.wrench, 6, nan["wrench"]),
            _raw("T_frame_tool", state.T_frame_tool, 16, nan["T_frame_tool"]),
            self._padded("q_ext", state.q_ext),
        ]  # fmt: skip
        parts += [_raw(name, record.get(name), len(empty) // 8, empty) for name, empty in self._extra]
        bits = tick.clamped
        if getattr(bits, "dtype", None) is not _U1 and bits is not None:
            bits = np.asarray(bits, dtype=_U1)
        clamped = nan["clamped"] if bits is None else bits.tobytes()
        if len(clamped) != n:
            raise ShapeError(f"Expected {n} values in clamped, got {len(clamped)}.")
        return b"".join([*parts, clamped, self._seldom(state, command, tick)])

    def pack_values(self, values: Mapping[str, Any]) -> bytes:
        """Return one row as bytes from values by column name; what is not given is missing.

        Raises
        ------
        UnknownName : a name that is not a column; lists those that are.
        ShapeError : a value has the wrong number of components.
        """
        row = bytearray(self._empty)
        for name, value in values.items():
            slot = self.slots.get(name)
            if slot is None:
                raise UnknownName.among("column", name, self.slots)
            array = np.asarray(value, dtype=slot.dtype)
            if array.shape != slot.column.shape:
                raise ShapeError(f"Expected shape {slot.column.shape} for {name}, got {array.shape}.")
            row[slot.start : slot.stop] = array.tobytes()
        return bytes(row)

    def unpack(self, rows: Iterable[bytes]) -> dict[str, np.ndarray]:
        """Return the columns (N, ...) of many rows; missing counts are NaN, missing clocks 0."""
        rows = list(rows)
        longest = max(map(len, rows), default=self._short)
        rest = self._empty[self._short : longest]
        whole = [row if len(row) == longest else row + rest for row in rows]
        block = np.frombuffer(b"".join(whole), dtype=np.uint8).reshape(-1, longest)
        values = {}
        for name, slot in self.slots.items():
            if slot.stop > longest:
                values[name] = np.full((len(block), *slot.column.shape), np.nan)
                continue
            raw = np.ascontiguousarray(block[:, slot.start : slot.stop]).view(slot.dtype)
            values[name] = with_holes(raw.reshape(len(block), *slot.column.shape), slot.missing)
        return values

    def _seldom(self, state: State, command: Command | None, tick: Tick) -> bytes:
        """Return the part of a row that is there when external axes are commanded or data goes to or from RAPID."""
        q_ext_ref = None if command is None else command.q_ext
        hears = state.rapid_digital or len(state.rapid_data) > 0
        given = (
            q_ext_ref, tick.q_ext_sent, state.rapid_data, tick.rapid_data_sent, (state.rapid_digital,) if hears else (),
            () if tick.rapid_digital_sent is None else (tick.rapid_digital_sent,),
        )  # fmt: skip
        if all(values is None or len(values) == 0 for values in given):
            return b""
        return b"".join([self._padded(name, values) for name, values in zip(_SELDOM, given, strict=True)])

    def _padded(self, name: str, values: Any) -> bytes:
        """Return as many values as the column has, NaN behind those given."""
        empty = self._nan[name]
        if values is None or len(values) == 0:
            return empty
        return (np.asarray(values, dtype="<f8").tobytes() + empty)[: len(empty)]


def with_holes(values: np.ndarray, missing: int | None) -> np.ndarray:
    """Return the values with NaN (so as floats) where they equal the mark for missing.

    A clock keeps its mark, zero: as floats its nanoseconds would be wrong by a hundred.
    """
    if missing is None or missing == NO_CLOCK:
        return values
    holes = values == missing
    return np.where(holes, np.nan, values) if holes.any() else values


def _raw(name: str, values: Any, count: int, empty: bytes) -> bytes:
    """Return the bytes of `count` doubles, or `empty` for None and for an array without values."""
    if values is None:
        return empty
    raw = values.tobytes() if getattr(values, "dtype", None) is _F8 else np.asarray(values, dtype=_F8).tobytes()
    if len(raw) == len(empty):
        return raw
    if not raw:
        return empty
    raise ShapeError(f"Expected {count} values in {name}, got {len(raw) // 8}.")
