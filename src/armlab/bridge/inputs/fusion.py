"""`Fusion`: newest reading of each source at each tick, with its age, freshness, and timestamp on the local clock.

Fusion keeps the last values; it neither waits nor interpolates. Stale values are NaN in a State but are still logged.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from armlab._display import Shown
from armlab.bridge.inputs.sources import TICK_COLUMNS, Reading, Source, whole
from armlab.bridge.net.events import Tell, nobody
from armlab.errors import ConfigError
from armlab.kinematics import forward
from armlab.log import Column
from armlab.robots import Robot

_WINDOW = 10_000_000_000  # ns, window of the running minimum
_BUCKET = 500_000_000  # ns per point of the minimum
_STEP = 50_000_000  # ns; a larger deviation means that the clock was set
_LATE_IN_A_ROW = 10  # consecutive late readings that indicate a clock set back rather than a delay
_DRIFT_SPAN = 3_000_000_000  # ns of data needed to separate drift from delays
_FASTEST_DRIFT = 1e-3  # s/s


class ClockMap:
    """Maps timestamps to the local clock using the running minimum of (receive - source) over 10 s, with drift
    compensation.

    Packets can be late but never early, so the minimum is the clock offset plus the shortest delay. A step above 50 ms
    restarts the estimate.
    """

    resets: int

    def __init__(self) -> None:
        self.resets = 0
        self._forget()

    def _forget(self) -> None:
        self._points: deque[tuple[int, int]] = deque()  # (source, offset) of the smallest offset in each bucket
        self._drift, self._late = 0.0, 0
        self._line: tuple[int, float] = (0, 0.0)  # source timestamp, and the offset at that time

    def reset(self) -> None:
        """Restart the estimate after the source's clock has been set or its program has restarted."""
        self.resets += 1
        self._forget()

    def add(self, source_ns: int, receive_ns: int) -> int:
        offset = receive_ns - source_ns
        if self._points:
            error = offset - self._offset(source_ns)
            self._late = self._late + 1 if error > _STEP else 0
            if error < -_STEP or self._late >= _LATE_IN_A_ROW or source_ns < self._points[-1][0] - _STEP:
                self.reset()
        points = self._points
        if points and source_ns // _BUCKET == points[-1][0] // _BUCKET:
            if offset < self._offset(source_ns) or offset < points[-1][1]:
                points[-1] = (source_ns, offset)
                self._fit()
        else:
            points.append((source_ns, offset))
            while source_ns - points[0][0] > _WINDOW:
                points.popleft()
            self._fit()
        return source_ns + round(self._offset(source_ns))

    def _offset(self, source_ns: int) -> float:
        start, offset = self._line
        return offset + self._drift * (source_ns - start)

    def _fit(self) -> None:
        """Fit a line with the least-squares slope through the lowest point, such that no point lies below it."""
        start, first = self._points[0]
        steps = [(source - start, offset - first) for source, offset in self._points]
        self._drift = 0.0
        if steps[-1][0] >= _DRIFT_SPAN:
            t, d = np.array(steps, dtype=float).T
            slope = float(((t - t.mean()) * (d - d.mean())).sum() / ((t - t.mean()) ** 2).sum())
            self._drift = min(max(slope, -_FASTEST_DRIFT), _FASTEST_DRIFT)
        self._line = (start, first + min(step - self._drift * at for at, step in steps))


_AHEAD = 1.0  # s: maximum lead of a reading over the packet of its tick, which may have waited in the socket


@dataclass(frozen=True, slots=True, repr=False)
class Held(Shown):
    """Reading of one source, held at a tick; ``held["field"]`` returns the value of a field.

    Attributes
    ----------
    values : mapping
        Values by field; NaN if stale or missing.
    kept : mapping
        Last values, regardless of their age.
    age : float, s
        Time since the values arrived; infinite before the first reading.
    fresh : bool
        Whether the reading is new in this tick.
    stale : bool
        Whether the values are older than the source's `max_age`.
    gaps : int
        Number of lost readings.
    seq : int
        Sequence number of the reading; 0 before the first reading.
    source_ns : int, ns
        Timestamp on the source's clock; 0 if the source sends no timestamps.
    receive_ns : int, ns
        Arrival time on the local monotonic clock; 0 before the first reading.
    mapped_ns : int, ns
        The source's timestamp converted to the local clock; 0 if the source sends no timestamps.
    """

    values: Mapping[str, np.ndarray]
    kept: Mapping[str, np.ndarray]
    age: float
    fresh: bool
    stale: bool
    gaps: int = 0
    seq: int = 0
    source_ns: int = 0
    receive_ns: int = 0
    mapped_ns: int = 0

    def __getitem__(self, field: str) -> np.ndarray:
        return self.values[field]


class Fusion:
    """Samples several sources at common ticks."""

    sources: tuple[Source, ...]

    def __init__(self, sources: Sequence[Source], on_event: Tell = nobody) -> None:
        for source in sources:
            if not isinstance(source, Source):
                raise ConfigError(f"Expected instances of bridge.Source as sources, got {type(source).__name__}.")
        names = [source.name for source in sources]
        if len(set(names)) < len(names) or sum(source.role == "pacing" for source in sources) > 1:
            raise ConfigError(f"Expected sources with different names and at most one pacing source, got {names}.")
        self.sources, self.missing, self._on_event = tuple(sources), "", on_event
        self.columns: dict[str, Column] = {
            f"{source.name}.{field}": column
            for source in sources
            for field, column in {**source.fields, **TICK_COLUMNS}.items()
        }
        self._nothing = {source.name: source.values({}) for source in sources}
        self._maps = {source.name: ClockMap() for source in sources}
        self._last: dict[str, tuple[Reading, int]] = {}  # reading and mapped timestamp
        self._stale: set[str] = set()
        self._reported: dict[str, str] = {}

    def tick(self, now_ns: int) -> Mapping[str, Held]:
        held = {source.name: self._hold(source, now_ns) for source in self.sources}
        self.missing: str = next((s.name for s in self.sources if s.role == "required" and held[s.name].stale), "")
        return MappingProxyType(held)

    def ticks(self, seconds: float) -> Iterator[Mapping[str, Held]]:
        """Yield the held readings at each new reading of the pacing source, for recording rows without a robot."""
        pacing = next((source for source in self.sources if source.role == "pacing"), None)
        if pacing is None:
            raise ConfigError("Expected one source with the role pacing, got none. Add a bridge.TimerSource.")
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            before = self._last.get(pacing.name)
            held = self.tick(time.monotonic_ns())
            if held[pacing.name].fresh:
                yield held
            elif before is self._last.get(pacing.name):
                time.sleep(0.1 * pacing.period)

    def fields(self, now_ns: int, robot: Robot, q: np.ndarray) -> dict[str, Any]:
        """Return the State field `sources` at a tick and, with a force sensor, the field `wrench`."""
        held = self.tick(now_ns)
        found: dict[str, Any] = {"sources": held}
        for source in self.sources:
            if source.robot not in ("", robot.name):
                continue
            if "wrench" in source.fields:
                found["wrench"] = held[source.name].values["wrench"]
            elif source.calibration is not None:
                wrench = source.calibration.wrench(held[source.name].values["wrench_raw"], forward(robot, q))
                wrench.flags.writeable = False
                found["wrench"] = wrench
        return found

    def record(self, held: Mapping[str, Held], now_ns: int) -> dict[str, Any]:
        """Return the values of the log columns, including stale values."""
        row: dict[str, Any] = {}
        for name, one in held.items():
            if not one.receive_ns:
                continue
            for field, value in one.kept.items():
                row[f"{name}.{field}"] = value
            row[f"{name}.age"] = 1e-9 * (now_ns - one.receive_ns)
            row[f"{name}.gaps"], row[f"{name}.seq"] = float(one.gaps), float(one.seq)
            if one.source_ns:
                row[f"{name}.source_time"] = 1e-9 * one.source_ns
                row[f"{name}.delay"] = 1e-9 * (one.receive_ns - one.mapped_ns)
        return row

    def _hold(self, source: Source, now_ns: int) -> Held:
        name = source.name
        source.now_ns = now_ns
        last = self._last.get(name)
        reading = self._newest(source, None if last is None else last[0])
        if source.problem and self._reported.get(name) != source.problem:
            self._reported[name] = source.problem
            self._on_event(f"The source {name} has a problem: {source.problem}.", warn=True)
        if reading is None:
            return Held(self._nothing[name], self._nothing[name], float("inf"), False, True)
        fresh = last is None or (reading.seq, reading.receive_ns) != (last[0].seq, last[0].receive_ns)
        if fresh:
            last = self._last[name] = (reading, self._mapped(source, reading, None if last is None else last[0]))
        age = max(1e-9 * (now_ns - reading.receive_ns), 0.0)
        stale = age > source.max_age
        if stale and name not in self._stale:
            self._stale.add(name)
            self._on_event(f"The source {name} is stale: its last reading is {age:.3f} s old.", warn=True)
        elif not stale and name in self._stale:
            self._stale.discard(name)
            self._on_event(f"The source {name} is fresh again.")
        values = self._nothing[name] if stale else reading.values
        return Held(
            values, reading.values, age, fresh, stale, reading.gaps, reading.seq, reading.source_ns,
            reading.receive_ns, last[1] if last is not None else 0,
        )  # fmt: skip

    def _newest(self, source: Source, last: Reading | None) -> Reading | None:
        """Return the latest reading of a source, or the previous reading after an error or an invalid reading."""
        try:
            reading = source.newest()
            if reading is None or reading is last:
                return reading
            values = {field: np.asarray(value) for field, value in reading.values.items()}
            for number in (reading.source_ns, reading.receive_ns, reading.seq, reading.gaps):
                whole(number)
            ahead = 1e-9 * (reading.receive_ns - source.now_ns)
        except Exception as error:  # an error in a custom source must not stop the loop
            source.problem = f"{type(error).__name__}: {error}"
            return last
        shapes = {field: value.shape for field, value in values.items()}
        if shapes != {field: column.shape for field, column in source.fields.items()}:
            source.problem = f"expected the fields {', '.join(source.fields)} with their declared shapes, got {shapes}"
            return last
        if wrong := [field for field, value in values.items() if value.dtype.kind not in "biuf"]:
            source.problem = f"expected numbers in {', '.join(wrong)}"
            return last
        if ahead > _AHEAD:  # the age would stay 0 if the source stopped
            source.problem = (
                f"expected a timestamp from time.monotonic_ns(), got a timestamp {ahead:.3g} s in the future"
            )
            return last
        return reading

    def _mapped(self, source: Source, reading: Reading, last: Reading | None) -> int:
        if not reading.source_ns:
            return 0
        clock = self._maps[source.name]
        if last is not None and reading.seq < last.seq:
            clock.reset()
            self._on_event(
                f"The source {source.name} restarted: sequence number {reading.seq} after {last.seq}.", warn=True
            )
            return clock.add(reading.source_ns, reading.receive_ns)
        before = clock.resets
        mapped = clock.add(reading.source_ns, reading.receive_ns)
        if clock.resets > before:
            self._on_event(
                f"The clock of the source {source.name} was adjusted. The clock mapping restarts.", warn=True
            )
        return mapped
