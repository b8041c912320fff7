"""Rows of a recording as bytes, packed in the loop within microseconds and unpacked offline."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from armlab.errors import RobotError, ShapeError, UnknownName
from armlab.kernels import RowPacker
from armlab.log.column import Column, resolved
from armlab.log.table import QD_SOURCES, TAU_SOURCES
from armlab.robots import Robot
from armlab.state import Command, State

# Markers of missing values in counts, clocks and flags.
NO_COUNT, NO_CLOCK, NO_FLAG = -1, 0, 255

# The columns of a tick, for recordings and for the rows of servers: column -> object and attribute.
COUNTS = {
    "stamp_ns": "tick.stamp_ns", "tick": "tick.number", "seq": "state.seq", "seq_sent": "tick.seq_sent",
    "session": "state.session", "missed": "state.missed", "drops": "tick.drops", "robot_ns": "state.robot_ns",
    "receive_ns": "tick.receive_ns", "send_ns": "tick.send_ns", "step_ns": "tick.step_ns", "wake_ns": "tick.wake_ns",
    "motors": "state.motors", "mci": "state.mci", "rapid": "state.rapid",
}  # fmt: skip
CODES: dict[str, tuple[str, ...]] = {"qd_source": QD_SOURCES, "tau_source": TAU_SOURCES}
REALS = {"session_t": "state.t", "dt": "state.dt", "utilization": "state.utilization"}
FLAGS = {"converged": "state.converged", "late": "tick.late"}
JOINTS = {
    "q": "state.q", "qd": "state.qd", "tau": "state.tau", "q_planned": "state.q_planned", "q_ref": "command.q",
    "qd_ref": "command.qd", "tau_ref": "command.tau", "q_sent": "tick.q_sent", "qd_sent": "tick.qd_sent",
    "tau_sent": "tick.tau_sent",
}  # fmt: skip
ESTIMATE = {"wrench_hat": Column((6,)), "wrench_hat_cov": Column((6, 6))}
# column -> source, form (see `kernels.RowPacker`), shape
FIXED: dict[str, tuple[str, str, tuple[int, ...]]] = {
    "wrench_raw": ("state.wrench_raw", "doubles", (6,)),
    "wrench": ("state.wrench", "doubles", (6,)),
    "T_frame_tool": ("state.T_frame_tool", "doubles", (4, 4)),
    "q_ext": ("state.q_ext", "padded", (6,)),
}
_SELDOM = {
    "q_ext_ref": ("command.q_ext", "padded", (6,)),
    "q_ext_sent": ("tick.q_ext_sent", "padded", (6,)),
    "rapid_data": ("state.rapid_data", "padded", (40,)),
    "rapid_data_sent": ("tick.rapid_data_sent", "padded", (40,)),
    "rapid_digital": ("state.rapid_digital", "heard", ()),
    "rapid_digital_sent": ("tick.rapid_digital_sent", "said", ()),
}
SELDOM = tuple(_SELDOM)
"""Columns of commanded axes and of values exchanged with RAPID, at the end of a row; most rows omit them."""

_DTYPES = {"count": "<i8", "code": "<i8", "flag": "u1", "bits": "u1"}  # by form; default: float


class Tick(NamedTuple):
    """Bridge data of one tick in addition to `State` and `Command`.

    Attributes
    ----------
    number : increasing tick number of the bridge.
    seq_sent : sequence number of the reply, -1 if none was sent.
    stamp_ns : wall-clock time at start plus monotonic time since start, int64 nanoseconds.
    receive_ns, send_ns : time of arrival, and time just before sending (-1 if nothing was sent) [ns].
    step_ns : time spent in the controller [ns].
    late : whether the controller missed its deadline.
    drops : number of datagrams dropped so far.
    q_sent, qd_sent, tau_sent : (n,) references sent after the limits, or None.
    clamped : (n,) bits of the active limits, or None.
    record : values that the bridge adds to declared columns, besides those from the Command.
    q_ext_sent, rapid_data_sent, rapid_digital_sent : values sent to external axes and to RAPID, or None.
    wake_ns : latency from packet arrival (kernel timestamp, if available) to the wake-up of the loop [ns]; -1 if
        unknown.
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
    wake_ns: int = NO_COUNT


@dataclass(frozen=True, slots=True)
class Slot:
    """Position of one column in a row: bytes [start, stop) of type `dtype`, and the marker of missing values."""

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
        """Bytes that encode a missing value."""
        missing = np.nan if self.dtype == "<f8" else self.missing or 0
        return np.full(self.size, missing, self.dtype).tobytes()


class RowLayout:
    """Row layout of one arm: the standard columns and those declared in `extra`.

    `pack` encodes a State, a Command (or None) and a Tick as one row. None and empty values count as missing.
    """

    def __init__(self, robot: Robot, extra: Mapping[str, Column] | None = None) -> None:
        if not isinstance(robot, Robot):
            raise RobotError.no_robot(robot)
        self.n: int = robot.n
        self.extra: dict[str, Column] = {
            name: resolved(column, name) for name, column in {**ESTIMATE, **(extra or {})}.items()
        }
        self.slots: dict[str, Slot] = {}
        self.size: int = 0
        self._places: list[tuple[str, str, str, str, bytes, Any]] = []
        self._add_standard(robot)
        for name, (source, form, shape) in FIXED.items():
            self._add(name, source, form, Column(shape))
        for name, column in self.extra.items():
            if name in self.slots or column.kind == "text":
                raise ShapeError(f"Expected numeric columns with new names in `extra`, got {name!r} ({column.kind}).")
            self._add(name, f"record.{name}", "doubles", column)
        joints = Column((robot.n,), labels=robot.joint_names)
        self._add("clamped", "tick.clamped", "bits", joints, NO_FLAG)
        self._short = self.size
        for name, (source, form, shape) in _SELDOM.items():
            self._add(name, source, form, Column(shape), detail="rapid_data")
        self._empty = b"".join(place[4] for place in self._places)
        self.pack: Callable[[Any, Any, Any], bytes] = RowPacker((State, Command, Tick), self._places, SELDOM[0]).pack

    def _add_standard(self, robot: Robot) -> None:
        for name, source in COUNTS.items():
            column = Column(unit="ns", kind="count") if name == "stamp_ns" else Column()
            missing = {"stamp_ns": None, "robot_ns": NO_CLOCK, "receive_ns": NO_CLOCK}.get(name, NO_COUNT)
            self._add(name, source, "count", column, missing)
        for name, words in CODES.items():
            codes = {word: code for code, word in enumerate(words)}
            self._add(name, f"state.{name}", "code", Column(), NO_COUNT, codes)
        for name, source in REALS.items():
            self._add(name, source, "real", Column())
        for name, source in FLAGS.items():
            self._add(name, source, "flag", Column(), NO_FLAG)
        for name, source in JOINTS.items():
            self._add(name, source, "doubles", Column((robot.n,), labels=robot.joint_names))

    def _add(
        self, name: str, source: str, form: str, column: Column, missing: int | None = None, detail: Any = None
    ) -> None:
        column, dtype = resolved(column, name), _DTYPES.get(form, "<f8")
        stop = self.size + int(np.prod(column.shape, dtype=int)) * np.dtype(dtype).itemsize
        self.slots[name] = slot = Slot(column, self.size, stop, dtype, missing)
        owner, field = source.split(".", 1)
        self._places.append((name, owner, field, form, slot.nothing, detail))
        self.size = stop

    def pack_values(self, values: Mapping[str, Any]) -> bytes:
        """Encode values by column name as one row; omitted values are missing."""
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
        """Decode rows into columns (N, ...); missing counts are NaN, missing clocks are 0."""
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


def with_holes(values: np.ndarray, missing: int | None) -> np.ndarray:
    """Return the values with NaN in place of the missing marker.

    A clock column keeps 0 as its missing-value marker, because a float would round its value to about a hundred
    nanoseconds.
    """
    if missing is None or missing == NO_CLOCK:
        return values
    holes = values == missing
    return np.where(holes, np.nan, values) if holes.any() else values
