"""`Source` and its subclasses: values from other programs, fused with the arms. A source never blocks the loop.

A source stores its latest `Reading`; `fusion` reads it in each tick. For a custom source, subclass `Source` and define
`newest`.
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
from armlab.estimation.fit import Fit, value_of
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
"""Log columns of each source in addition to its fields; `delay` is the time from the mapped timestamp to arrival."""


class Reading(NamedTuple):
    """One reading of a source; timestamps and sequence numbers have at most 64 bits.

    Attributes
    ----------
    values : mapping
        Values by field.
    source_ns : int, ns
        Timestamp on the source's clock; 0 if the source sends no timestamps.
    receive_ns : int, ns
        Arrival time on the local monotonic clock.
    seq : int
        Sequence number of the reading.
    gaps : int
        Number of lost readings, according to the sequence numbers.
    """

    values: Mapping[str, np.ndarray]
    source_ns: int
    receive_ns: int
    seq: int
    gaps: int = 0


def whole(number: Any, unit: int = 1) -> int:
    """Convert a received timestamp or sequence number to an integer of at most 64 bits."""
    plain = number.item() if isinstance(number, np.generic) else number
    if isinstance(plain, int | float) and abs(plain * unit) < 1 << 64:
        return int(plain * unit)
    raise ValueError(f"expected a finite number of at most 64 bits, got {str(plain)[:40]}")


class Source:
    """Base class of sources of external values; a subclass defines `newest`.

    Parameters
    ----------
    name : str
        Name of the source; its columns in the log are ``<name>.<field>``.
    fields : mapping
        Shape, unit and frame by field; names in the glossary keep their meaning. `State.wrench` is
        the calibrated ``wrench`` (6,) in base axes, or ``wrench_raw`` (6,) in sensor axes converted by `calibration`.
    period : float, s
        Nominal time between two readings.
    max_age : float, s
        Age at which values become stale; default: three periods or 20 ms, whichever is longer.
    role : str
        "required" (the arms hold while the source is stale), "pacing" (`Fusion.ticks` follows it) or "optional".
    robot : str
        Name of the arm to which the wrench belongs, "" for any; default: the arm of the calibration.
    calibration : ForceSensor
        Weight, bias and axes of the force sensor that sends ``wrench_raw``.

    Attributes
    ----------
    now_ns : int, ns
        Time of the current tick on the local monotonic clock.
    problem : str
        Message of the last error.

    Raises
    ------
    ConfigError
        An empty name or a name with a dot, no fields, a period or age of 0 or less, a calibration without the field
        ``wrench_raw``, or a field size that is negative or larger than a row.
    ShapeError
        A field contradicts the glossary, or its unit is missing.
    UnknownName
        The role is unknown.
    """

    name: str
    period: float
    calibration: ForceSensor | None
    problem: str
    now_ns: int

    def __init__(
        self,
        name: str,
        fields: Mapping[str, Column],
        period: float,
        max_age: float | None = None,
        role: Literal["pacing", "required", "optional"] = "optional",
        robot: str = "",
        calibration: ForceSensor | Fit[ForceSensor] | None = None,
    ) -> None:
        if not name or "." in name or not fields:
            raise ConfigError(f"Expected a source with fields and a name without dots, got {name!r} with {[*fields]}.")
        if not period > 0.0 or (max_age is not None and not max_age > 0.0):
            raise ConfigError(
                f"Expected period and max_age of the source {name!r} above 0 s, got {period} and {max_age}."
            )
        if role not in _ROLES:
            raise UnknownName.among("role of a source", role, _ROLES)
        sensor: ForceSensor | None = value_of(calibration)
        if sensor is not None:
            _check_calibration(name, fields, sensor)
        self.name, self.period, self.role, self.calibration = name, float(period), role, sensor
        self.robot: str = robot if robot or sensor is None else sensor.robot_name
        taken = [field for field in fields if field in TICK_COLUMNS]
        if taken:
            raise ConfigError(f"Expected field names other than the log's own columns, got {', '.join(taken)}.")
        _check_shapes(name, fields)
        self.fields: dict[str, Column] = {field: resolved(column, field) for field, column in fields.items()}
        self._missing = {field: np.full(column.shape, np.nan) for field, column in fields.items()}
        self.max_age: float = max(3.0 * period, _DEFAULT_AGE) if max_age is None else float(max_age)
        self.problem, self.now_ns = "", 0

    def start(self) -> None:
        """Start receiving; called before the run."""

    def close(self) -> None:
        """Stop receiving; called after every run, including failed runs."""

    def newest(self) -> Reading | None:
        """Return the latest reading, or None before the first reading; must neither block nor raise an error."""
        raise NotImplementedError

    def values(self, given: Mapping[str, Any]) -> Mapping[str, np.ndarray]:
        """Return values by field as read-only arrays of the declared shapes; missing fields are NaN.

        Parameters
        ----------
        given : mapping
            Values by field.

        Raises
        ------
        UnknownName
            A field is not declared.
        ConfigError
            Values are not numbers, or have the wrong shape.
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
    """Raise an error if a calibrated force sensor does not belong to an arm of the run."""
    if source.calibration is None:
        return
    if not source.robot and len(robots) > 1:
        names = ", ".join(robot.name for robot in robots)
        raise ConfigError(f'Expected robot= of the force sensor {source.name!r} to be one of {names}, got "".')
    hashes = [robot.hash for robot in robots if source.robot in ("", robot.name)]
    if source.calibration.robot_hash and source.calibration.robot_hash not in hashes:
        raise ModelMismatchError(
            f"Expected the calibration of the source {source.name!r} to belong to a robot of this run, got a "
            f"calibration of {source.calibration.robot_name!r} "
            f"({source.calibration.robot_hash[:12]}). Calibrate the sensor on this robot."
        )


def _check_shapes(name: str, fields: Mapping[str, Column]) -> None:
    for field, column in fields.items():
        if any(size < 0 for size in column.shape) or math.prod(column.shape) * 8 > LARGEST:
            shape = str(column.shape)[:60]
            raise ConfigError(
                f"Expected non-negative field sizes and at most {LARGEST // 8} numbers per field, got shape {shape} of "
                f"{field!r} in the source {name!r}."
            )


def _check_calibration(name: str, fields: Mapping[str, Column], calibration: object) -> None:
    raw = fields.get("wrench_raw")
    if not isinstance(calibration, ForceSensor) or "wrench" in fields or raw is None or raw.shape != (6,):
        raise ConfigError(
            f"Expected a ForceSensor as the calibration of the source {name!r}, with a field wrench_raw (6,) and no "
            f"field wrench, got {type(calibration).__name__} and the fields {', '.join(fields)}."
        )


class ThreadSource(Source):
    """Base class of sources with a thread: `work` stores readings in `_newest` until `_over` is set.

    Parameters
    ----------
    name : str
        Name of the source.
    fields : mapping
        Columns by field.
    period : float, s
        Nominal time between two readings.
    options
        See `Source`.
    """

    def __init__(self, name: str, fields: Mapping[str, Column], period: float, **options: Any) -> None:
        super().__init__(name, fields, period, **options)
        self._newest: Reading | None = None
        self._over = threading.Event()
        self._thread: threading.Thread | None = None

    def work(self) -> None:
        """Receive readings in the background thread; subclasses implement this method."""
        raise NotImplementedError

    def start(self) -> None:
        """Start the thread."""
        self._over.clear()
        self._thread = threading.Thread(target=self.work, name=f"source {self.name}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop the thread and wait at most 1 s for it to end."""
        self._over.set()
        if self._thread is not None:
            self._thread.join(1.0)

    def newest(self) -> Reading | None:
        """Return the latest reading, or None before the first reading."""
        return self._newest


class CallableSource(ThreadSource):
    """Source that calls a Python function in a thread, once per period.

    Parameters
    ----------
    name : str
        Name of the source.
    fields : mapping
        Columns by field.
    function : callable
        Returns values by field, or None if there are no new values. If the function raises an error, the source keeps
        the last reading and sets `problem`.
    period : float, s
        Time between two calls.
    options
        See `Source`.
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
            except Exception as error:  # in the user's function: the reading becomes stale, but the loop continues
                self.problem: str = f"{type(error).__name__}: {error}"


class TimerSource(Source):
    """Source that counts periods in its only field ``count``, used to record rows without a robot.

    Parameters
    ----------
    name : str
        Name of the source.
    period : float, s
        Time between two counts.
    options
        See `Source`; default role: "pacing".
    """

    def __init__(self, name: str, period: float, **options: Any) -> None:
        super().__init__(name, {"count": Column(unit="1")}, period, **{"role": "pacing", **options})
        self._begun_ns = time.monotonic_ns()

    def start(self) -> None:
        """Start counting."""
        self._begun_ns = time.monotonic_ns()

    def newest(self) -> Reading | None:
        """Return the number of complete periods since the start, with the end of the last period as the timestamp."""
        count = int((time.monotonic_ns() - self._begun_ns) / (1e9 * self.period))
        stamp_ns = self._begun_ns + int(1e9 * count * self.period)
        return Reading(self.values({"count": count}), stamp_ns, stamp_ns, count)


class ReplaySource(Source):
    """Source that replays a recorded source: the same readings at the same ticks, through the same fusion.

    Parameters
    ----------
    name : str
        Name of the source in the recording.
    table : Table
        The recording.
    period : float, s
        Nominal time between two readings.
    options
        See `Source`.

    Raises
    ------
    UnknownName
        The source is not in the recording.
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
        absent = np.full(len(table), np.nan)  # a source without a clock or sequence numbers
        self._counts = {one: table.values.get(f"{prefix}{one}", absent) for one in ("seq", "gaps", "source_time")}
        self._ticks_ns = table["receive_ns"] - table["receive_ns"][0]
        self._begun_ns: int | None = None
        self._row, self._newest = -1, None

    def newest(self) -> Reading | None:
        """Return the recorded reading for the time elapsed since the first tick."""
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
        recorded = [float(counts[row]) for counts in self._counts.values()]
        seq, gaps, seconds = (one if np.isfinite(one) else 0.0 for one in recorded)
        values = self.values({name: array[row] for name, array in self._values.items()})
        return Reading(values, round(1e9 * seconds), receive_ns, int(seq), int(gaps))


_STAMPS = ("seq", "stamp_ns")
_DRAINED = 64  # maximum number of datagrams per tick, so a flood does not block the loop
_BACKLOG = 2000  # the same in the first tick; these may have arrived before the first robot packet
_MOST_GAPS = 1 << 53  # largest exact integer in the log


class UdpSource(Source):
    """Source that receives datagrams on a UDP port of this computer, as binary numbers or JSON.

    Each tick reads all waiting datagrams and uses the newest valid one. The operating system timestamps arrivals.

    Parameters
    ----------
    name : str
        Name of the source.
    fields : mapping
        Columns by field.
    period : float, s
        Nominal time between two readings.
    port : int
        Port to listen on after `start`; 0 lets the operating system choose.
    layout : mapping or "json"
        NumPy type by name, in the order of the datagram, such as ``"<f8"`` or ``">u4"``: each field exactly once, and
        optionally ``seq`` and ``stamp_ns``. With "json", a datagram is a JSON object with these field names.
    host : str
        Address to listen on.
    options
        See `Source`.

    Attributes
    ----------
    drops : int
        Number of decoded datagrams that were invalid; older datagrams of the same tick are skipped without decoding.

    Raises
    ------
    ConfigError
        The layout lacks a field, or has an unknown name or a non-numeric type.
    """

    host: str
    drops: int

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
        LinkError
            The port cannot be bound.
        """
        self._port = Port(self.host, self.port)
        self.port = self._port.port

    def close(self) -> None:
        """Close the port."""
        if self._port is not None:
            self._port.close()
            self._port = None

    def newest(self) -> Reading | None:
        """Return the latest reading, or None before the first reading."""
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
        """Read the newest of `count` datagrams and skip the others; return whether the newest is valid."""
        last = self._newest
        try:
            given = json.loads(data) if self._layout is None else self._numbers(data, self._layout)
            if not isinstance(given, dict):
                raise ValueError("expected a JSON object")
            seq = whole(given.pop("seq", 0 if last is None else last.seq + count))
            stamp_ns = whole(given.pop("stamp_ns", 0))
            values = self.values(given)
        except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
            self.drops += 1
            self.problem: str = self.problem or f"invalid datagram, {type(error).__name__}: {error}"
            return False
        lost = 0 if last is None else max(seq - last.seq - count, 0)  # restarted numbering is not a loss
        gaps = 0 if last is None else min(last.gaps + lost, _MOST_GAPS)
        self._newest = Reading(values, stamp_ns, receive_ns, seq, gaps)
        return True

    def _record(self, layout: Mapping[str, str]) -> np.dtype[Any]:
        names = [name for name in layout if name not in _STAMPS]
        if not isinstance(layout, Mapping) or sorted(names) != sorted(self.fields):
            raise ConfigError(
                f"Expected the layout of the source {self.name!r} to contain {', '.join(self.fields)} exactly once "
                f"each, and optionally seq and stamp_ns, got {layout!r}."
            )
        try:
            shapes = {name: column.shape for name, column in self.fields.items()}
            record = np.dtype([(name, code, shapes.get(name, ())) for name, code in layout.items()])
        except TypeError:
            record = None
        if record is None or any(record[name].base.kind not in "iuf" for name in layout):
            raise ConfigError(f"Expected numeric types such as '<f8' in the layout, got {layout!r}.")
        return record

    @staticmethod
    def _numbers(data: bytes, layout: np.dtype[Any]) -> dict[str, Any]:
        if len(data) != layout.itemsize:
            raise ValueError(f"expected {layout.itemsize} bytes, got {len(data)}")
        row = np.frombuffer(data, layout)[0]
        return {name: row[name] for name in layout.names or ()}
