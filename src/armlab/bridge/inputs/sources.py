"""What is fused with the arms: a `Source` and its kinds. None of them ever makes the loop wait.

A source holds its latest `Reading`; the loop looks at it in each tick (`fusion`). A user's own is a subclass of
`Source` with the method `newest`.
"""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

import numpy as np

from armlab.bridge.net.sockets import Arrival, Port
from armlab.bridge.servers.row import LARGEST
from armlab.errors import ConfigError, ModelMismatchError, UnknownName
from armlab.log import Column, Table
from armlab.log.column import resolved
from armlab.models import ForceSensor
from armlab.robots import Robot

_DEFAULT_AGE = 0.02  # s
_ROLES = ("pacing", "required", "optional")
TICK_COLUMNS = {
    "age": Column(unit="s"),
    "gaps": Column(unit="1"),
    "seq": Column(unit="1"),
    "source_time": Column(unit="s"),
    "delay": Column(unit="s"),
}
"""Columns of each source in the log besides its fields; `delay` is from its own clock, mapped to ours, to arrival."""


class Reading(NamedTuple):
    """What a source gave once.

    Attributes
    ----------
    values : by field.
    source_ns : its own clock, 0 when it has none.
    receive_ns : our monotonic clock.
    seq : its number.
    gaps : readings lost so far, by its numbers. Each of them has at most 64 bits.
    """

    values: Mapping[str, np.ndarray]
    source_ns: int
    receive_ns: int
    seq: int
    gaps: int = 0


def whole(number: Any, unit: int = 1) -> int:
    """Return a stamp or a number that somebody sent as an integer of a reading."""
    plain = number.item() if isinstance(number, np.generic) else number
    if isinstance(plain, int | float) and abs(plain * unit) < 1 << 64:
        return int(plain * unit)
    raise ValueError(f"expected a finite number of at most 64 bits, got {str(plain)[:40]}")


class Source:
    """A source of values beside the arms; the kinds differ in where `newest` comes from.

    Parameters
    ----------
    name : of the source; its columns in the log are ``<name>.<field>``.
    fields : shape, unit and frame by field; names of the glossary mean what they mean there. A field ``wrench`` (6,),
        calibrated, in base axes, becomes `State.wrench`; one in the sensor's own axes is a ``wrench_raw``, and becomes
        `State.wrench` by its `calibration`.
    period : nominal time between two readings [s].
    max_age : age from which values are stale [s]; by default three periods or 20 ms, whichever is longer.
    role : "required": the arms hold while it is stale; "pacing": `Fusion.ticks` follows it; "optional".
    robot : name of the arm that the wrench belongs to, "" for any; by default that of the calibration.
    calibration : of the force sensor whose ``wrench_raw`` (6,) this is: weight, bias, axes.

    Attributes
    ----------
    now_ns : time of the tick that asks, our monotonic clock.
    problem : what went wrong last, in words.

    Raises
    ------
    ConfigError : a name with a dot or none, no fields, a period or an age that is not above 0, an unknown role, a
        calibration without raw readings, a field of a size below 0 or larger than a row.
    ShapeError, UnknownName : a field contradicts the glossary or lacks its unit.
    """

    def __init__(
        self,
        name: str,
        fields: Mapping[str, Column],
        period: float,
        max_age: float | None = None,
        role: Literal["pacing", "required", "optional"] = "optional",
        robot: str = "",
        calibration: ForceSensor | None = None,
    ) -> None:
        if not name or "." in name or not fields:
            raise ConfigError(f"Expected a source with fields and a name without dots, got {name!r} with {[*fields]}.")
        if not period > 0.0 or (max_age is not None and not max_age > 0.0):
            raise ConfigError(
                f"Expected period and max_age of the source {name!r} above 0 s, got {period} and {max_age}."
            )
        if role not in _ROLES:
            raise UnknownName.among("role of a source", role, _ROLES)
        if calibration is not None:
            _check_calibration(name, fields, calibration)
        self.name, self.period, self.role, self.calibration = name, float(period), role, calibration
        self.robot = robot if robot or calibration is None else calibration.robot_name
        taken = [field for field in fields if field in TICK_COLUMNS]
        if taken:
            raise ConfigError(f"Expected other names than those of the log's own columns, got {', '.join(taken)}.")
        _check_shapes(name, fields)
        self.fields = {field: resolved(column, field) for field, column in fields.items()}
        self._missing = {field: np.full(column.shape, np.nan) for field, column in fields.items()}
        self.max_age = max(3.0 * period, _DEFAULT_AGE) if max_age is None else float(max_age)
        self.problem, self.now_ns = "", 0

    def start(self) -> None:
        """Begin to receive; called before the run."""

    def close(self) -> None:
        """End; called after the run, also one that failed."""

    def newest(self) -> Reading | None:
        """Return the latest reading, None before the first. Never waits, never raises."""
        raise NotImplementedError

    def values(self, given: Mapping[str, Any]) -> Mapping[str, np.ndarray]:
        """Return values by field as read-only arrays of the declared shapes; a field not given is NaN.

        Parameters
        ----------
        given : by field.

        Raises
        ------
        UnknownName : a name that is no field.
        ConfigError : no numbers, or another shape.
        """
        for name in given:
            if name not in self.fields:
                raise UnknownName.among(f"field of the source {self.name!r}", name, self.fields)
        checked = {}
        for name, column in self.fields.items():
            try:
                array = np.array(given[name] if name in given else self._missing[name], dtype=np.float64)
            except (TypeError, ValueError) as error:
                raise ConfigError(f"Expected numbers in {name} of the source {self.name!r} ({error}).") from error
            if array.shape != column.shape:
                raise ConfigError(
                    f"Expected {name} of shape {column.shape} from the source {self.name!r}, got {array.shape}."
                )
            array.flags.writeable = False
            checked[name] = array
        return MappingProxyType(checked)


def check_source(source: Source, robots: Sequence[Robot]) -> None:
    """Check that a calibrated force sensor belongs to one of the arms of a run."""
    if source.calibration is None:
        return
    if not source.robot and len(robots) > 1:
        names = ", ".join(robot.name for robot in robots)
        raise ConfigError(f"Expected robot= of the force sensor {source.name!r}, one of {names}, got none.")
    hashes = [robot.hash for robot in robots if source.robot in ("", robot.name)]
    if source.calibration.robot_hash and source.calibration.robot_hash not in hashes:
        raise ModelMismatchError(
            f"Expected the calibration of the source {source.name!r} to be of a robot of this run, got one of "
            f"{source.calibration.robot_name!r} ({source.calibration.robot_hash[:12]}). Calibrate on this robot."
        )


def _check_shapes(name: str, fields: Mapping[str, Column]) -> None:
    for field, column in fields.items():
        if any(size < 0 for size in column.shape) or math.prod(column.shape) * 8 > LARGEST:
            shape = str(column.shape)[:60]
            raise ConfigError(
                f"Expected a field of sizes from 0 and at most {LARGEST // 8} numbers, as a row has, got the shape "
                f"{shape} of {field!r} in the source {name!r}."
            )


def _check_calibration(name: str, fields: Mapping[str, Column], calibration: object) -> None:
    raw = fields.get("wrench_raw")
    if not isinstance(calibration, ForceSensor) or "wrench" in fields or raw is None or raw.shape != (6,):
        raise ConfigError(
            f"Expected a ForceSensor as the calibration of the source {name!r}, and a field wrench_raw (6,) but none "
            f"called wrench, got {type(calibration).__name__} and the fields {', '.join(fields)}."
        )


class ThreadSource(Source):
    """Source with a thread: `work` runs until `_over` is set and leaves its readings in `_newest`. Subclass it.

    Parameters
    ----------
    name : of the source.
    fields : columns by name.
    period : seconds between two readings.
    options : see `Source`.
    """

    def __init__(self, name: str, fields: Mapping[str, Column], period: float, **options: Any) -> None:
        super().__init__(name, fields, period, **options)
        self._newest: Reading | None = None
        self._over = threading.Event()
        self._thread: threading.Thread | None = None

    def work(self) -> None:
        """Receive readings, in the thread. A subclass defines it."""
        raise NotImplementedError

    def start(self) -> None:
        """Start the thread."""
        self._over.clear()
        self._thread = threading.Thread(target=self.work, name=f"source {self.name}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread; one that hangs is left behind."""
        self._over.set()
        if self._thread is not None:
            self._thread.join(1.0)

    def newest(self) -> Reading | None:
        """Return the latest reading, None before the first."""
        return self._newest


class CallableSource(ThreadSource):
    """A Python function called in a thread of its own, once per period.

    Parameters
    ----------
    name, fields, period, options : see `Source`.
    function : called without arguments; returns values by field, or None when there is nothing new. When it raises, the
        reading stays and grows old; `problem` says why.
    """

    def __init__(
        self,
        name: str,
        fields: Mapping[str, Column],
        function: Callable[[], Mapping[str, Any] | None],
        period: float,
        **options: Any,
    ) -> None:
        super().__init__(name, fields, period, **options)
        self._function = function

    def work(self) -> None:
        """Call the function once per period."""
        due, seq = time.monotonic(), 0
        while not self._over.wait(max(due - time.monotonic(), 0.0)):
            due = max(due + self.period, time.monotonic())
            try:
                given = self._function()
                if given is not None:
                    values = self.values(given)
                    self._newest, seq = Reading(values, 0, time.monotonic_ns(), seq), seq + 1
            except Exception as error:  # a user's function: its source grows old, the loop goes on
                self.problem = f"{type(error).__name__}: {error}"


class TimerSource(Source):
    """Counter of periods: paces rows where there is no robot. Its one field is ``count``.

    Parameters
    ----------
    name : of the source.
    period : seconds between two counts.
    options : see `Source`; `role` is "pacing" by default.
    """

    def __init__(self, name: str, period: float, **options: Any) -> None:
        super().__init__(name, {"count": Column(unit="1")}, period, **{"role": "pacing", **options})
        self._begun_ns = time.monotonic_ns()

    def start(self) -> None:
        """Count from now."""
        self._begun_ns = time.monotonic_ns()

    def newest(self) -> Reading | None:
        """Return the number of whole periods since the start, stamped with when the last of them was over."""
        count = int((time.monotonic_ns() - self._begun_ns) / (1e9 * self.period))
        stamp_ns = self._begun_ns + int(1e9 * count * self.period)
        return Reading(self.values({"count": count}), stamp_ns, stamp_ns, count)


class ReplaySource(Source):
    """Replay of a recorded source: the same readings at the same ticks, through the same fusion.

    Parameters
    ----------
    name : of the source in the recording.
    table : the recording.
    period : seconds between two readings.
    options : see `Source`.

    Raises
    ------
    UnknownName : the recording has no such source.
    """

    def __init__(self, name: str, table: Table, period: float, **options: Any) -> None:
        prefix, own = f"{name}.", TICK_COLUMNS
        names = [one for one in table.names if one.startswith(prefix) and one.removeprefix(prefix) not in own]
        if not names or f"{prefix}age" not in table:
            known = sorted({one.partition(".")[0] for one in table.names if one.endswith(".age")})
            raise UnknownName.among("source in this recording", name, known)
        fields = {one.removeprefix(prefix): table.columns[one] for one in names}
        super().__init__(name, fields, period, **options)
        self._values = {one.removeprefix(prefix): table[one] for one in names}
        self._ages_ns = np.rint(1e9 * table[f"{prefix}age"])
        absent = np.full(len(table), np.nan)  # the source had no clock or numbers of its own
        self._counts = {one: table.values.get(f"{prefix}{one}", absent) for one in ("seq", "gaps", "source_time")}
        self._ticks_ns = table["receive_ns"] - table["receive_ns"][0]
        self._begun_ns: int | None = None
        self._row, self._newest = -1, None

    def newest(self) -> Reading | None:
        """Return what the recording held at this time; it begins with the first tick."""
        if self._begun_ns is None:
            self._begun_ns = self.now_ns
        row = int(np.searchsorted(self._ticks_ns, self.now_ns - self._begun_ns, side="right")) - 1
        if row != self._row:
            self._row, self._newest = row, self._reading(row)
        return self._newest

    def _reading(self, row: int) -> Reading | None:
        if row < 0 or not np.isfinite(self._ages_ns[row]) or self._begun_ns is None:
            return None
        receive_ns = self._begun_ns + int(self._ticks_ns[row]) - int(self._ages_ns[row])
        told = [float(counts[row]) for counts in self._counts.values()]
        seq, gaps, seconds = (one if np.isfinite(one) else 0.0 for one in told)
        values = self.values({name: array[row] for name, array in self._values.items()})
        return Reading(values, round(1e9 * seconds), receive_ns, int(seq), int(gaps))


_STAMPS = ("seq", "stamp_ns")
_DRAINED = 64  # datagrams per tick: a flood cannot hold the loop up
_BACKLOG = 2000  # at first: what came before the robot did
_MOST_GAPS = 1 << 53  # whole numbers in the log


class UdpSource(Source):
    """Datagrams on a UDP port of this computer, as numbers in a fixed order or as JSON.

    Every datagram that waits is taken in a tick and the newest that can be read is used; the kernel stamps arrivals.

    Parameters
    ----------
    name, fields, period, options : see `Source`.
    port, host : where to listen, from `start` on; port 0 lets the system choose.
    layout : the numbers in order, name -> NumPy type such as ``"<f8"`` or ``">u4"``: each field once, and if sent
        ``seq`` and ``stamp_ns``. Or "json": one object with these names.

    Attributes
    ----------
    drops : datagrams that could not be read; those before a newer one in the same tick are not looked at.

    Raises
    ------
    ConfigError : a layout without one of the fields, with another name or a type that is no number.
    """

    def __init__(
        self,
        name: str,
        fields: Mapping[str, Column],
        period: float,
        port: int,
        layout: Mapping[str, str] | Literal["json"] = "json",
        host: str = "127.0.0.1",
        **options: Any,
    ) -> None:
        super().__init__(name, fields, period, **options)
        self._layout = None if layout == "json" else self._record(layout)
        self.host, self.port = host, port
        self._port: Port | None = None
        self.drops = 0
        self._newest: Reading | None = None

    def start(self) -> None:
        """Bind the port.

        Raises
        ------
        LinkError : it cannot be bound.
        """
        self._port = Port(self.host, self.port)
        self.port = self._port.port

    def close(self) -> None:
        """Close the port."""
        if self._port is not None:
            self._port.close()
            self._port = None

    def newest(self) -> Reading | None:
        """Return the latest reading, None before the first."""
        waiting: list[Arrival] = []
        most = _BACKLOG if self._newest is None else _DRAINED
        while self._port is not None and len(waiting) < most:
            arrival = self._port.receive()
            if arrival is None:
                break
            waiting.append(arrival)
        while waiting and not self._take(waiting[-1].data, waiting[-1].ns, len(waiting)):
            waiting.pop()
        return self._newest

    def _take(self, data: bytes, receive_ns: int, count: int) -> bool:
        """Read the newest of `count` datagrams, so that those before it cost nothing. Return whether that went well."""
        last = self._newest
        try:
            given = self._json(data) if self._layout is None else self._numbers(data, self._layout)
            seq = whole(given.pop("seq", 0 if last is None else last.seq + count))
            stamp_ns = whole(given.pop("stamp_ns", 0))
            values = self.values(given)
        except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
            self.drops += 1
            self.problem = self.problem or f"a datagram could not be read, {type(error).__name__}: {error}"
            return False
        lost = 0 if last is None else max(seq - last.seq - count, 0)  # a restart of the numbers loses nothing
        gaps = 0 if last is None else min(last.gaps + lost, _MOST_GAPS)
        self._newest = Reading(values, stamp_ns, receive_ns, seq, gaps)
        return True

    def _record(self, layout: Mapping[str, str]) -> np.dtype[Any]:
        names = [name for name in layout if name not in _STAMPS]
        if not isinstance(layout, Mapping) or sorted(names) != sorted(self.fields):
            raise ConfigError(
                f"Expected the layout of the source {self.name!r} to hold {', '.join(self.fields)} once each, and "
                f"seq and stamp_ns where they are sent, got {layout!r}."
            )
        try:
            shapes = {name: column.shape for name, column in self.fields.items()}
            record = np.dtype([(name, code, shapes.get(name, ())) for name, code in layout.items()])
        except TypeError as error:
            raise ConfigError(f"Expected types of numbers such as '<f8' in the layout, got {layout!r}.") from error
        if any(record[name].base.kind not in "iuf" for name in layout):
            raise ConfigError(f"Expected types of numbers such as '<f8' in the layout, got {layout!r}.")
        return record

    @staticmethod
    def _numbers(data: bytes, layout: np.dtype[Any]) -> dict[str, Any]:
        if len(data) != layout.itemsize:
            raise ValueError(f"expected {layout.itemsize} bytes, got {len(data)}")
        row = np.frombuffer(data, layout)[0]
        return {name: row[name] for name in layout.names or ()}

    @staticmethod
    def _json(data: bytes) -> dict[str, Any]:
        given = json.loads(data)
        if not isinstance(given, dict):
            raise ValueError("expected a JSON object")
        return given
