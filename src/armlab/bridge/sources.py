"""What is fused with the arms: a `Source` and its kinds. None of them ever makes the loop wait.

A source holds its latest `Reading`; the loop looks at it in each tick (`fusion`). A user's own is a subclass of
`Source` with the method `newest`. More kinds are in `udp` and `replay`.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

import numpy as np

from armlab.bridge.row_schema import LARGEST
from armlab.errors import ConfigError, ModelMismatchError, UnknownName
from armlab.log import Column
from armlab.models import ForceSensor
from armlab.robots import Robot

__all__ = ["TICK_COLUMNS", "CallableSource", "Reading", "Source", "ThreadSource", "TimerSource", "whole"]

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
    values : by field. source_ns : its own clock, 0 when it has none. receive_ns : our monotonic clock.
    seq : its number. gaps : readings lost so far, by its numbers. Each of them has at most 64 bits.
    """

    values: Mapping[str, np.ndarray]
    source_ns: int
    receive_ns: int
    seq: int
    gaps: int = 0


def whole(number: Any, unit: int = 1) -> int:
    """Return a stamp or a number that somebody sent as an integer of a reading.

    Parameters
    ----------
    number : what was sent. unit : by which to multiply it.

    Raises
    ------
    ValueError : no number, one that is not finite, or one beyond 64 bits.
    """
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
    now_ns : time of the tick that asks, our monotonic clock. problem : what went wrong last, in words.

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
        self.fields = {field: column.resolved(field) for field, column in fields.items()}
        self._missing = {field: np.full(column.shape, np.nan) for field, column in fields.items()}
        self.max_age = max(3.0 * period, _DEFAULT_AGE) if max_age is None else float(max_age)
        self.problem, self.now_ns = "", 0

    def start(self) -> None:
        """Begin to receive; called before the run."""

    def close(self) -> None:
        """End; called after the run, also one that failed."""

    def check(self, robots: Sequence[Robot]) -> None:
        """Check that a calibrated force sensor belongs to one of the arms of a run.

        Parameters
        ----------
        robots : the arms.

        Raises
        ------
        ConfigError : it does not say to which of several. ModelMismatchError : it was fitted on another robot.
        """
        if self.calibration is None:
            return
        if not self.robot and len(robots) > 1:
            names = ", ".join(robot.name for robot in robots)
            raise ConfigError(f"Expected robot= of the force sensor {self.name!r}, one of {names}, got none.")
        hashes = [robot.hash for robot in robots if self.robot in ("", robot.name)]
        if self.calibration.robot_hash and self.calibration.robot_hash not in hashes:
            raise ModelMismatchError(
                f"Expected the calibration of the source {self.name!r} to be of a robot of this run, got one of "
                f"{self.calibration.robot_name!r} ({self.calibration.robot_hash[:12]}). Calibrate on this robot."
            )

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
        UnknownName : a name that is no field. ConfigError : no numbers, or another shape.
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
    """A source with a thread of its own, which does `work` until `_over` is set and leaves what it has in `_newest`.

    Parameters
    ----------
    name, fields, period, options : see `Source`.
    """

    def __init__(self, name: str, fields: Mapping[str, Column], period: float, **options: Any) -> None:
        super().__init__(name, fields, period, **options)
        self._newest: Reading | None = None
        self._over = threading.Event()
        self._thread: threading.Thread | None = None

    def work(self) -> None:
        """Receive; in the thread."""
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
    function : called without arguments; returns values by field, or None when there is nothing new. When it raises,
        the reading stays and grows old; `problem` says why.
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
    """Counts periods: the pace of rows where no robot gives one. Its field is ``count``.

    Parameters
    ----------
    name, period, options : see `Source`.
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
