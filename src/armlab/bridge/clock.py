"""Time of the robot: `RobotClock` gives dt between packets, `Period` the robot's true cycle time."""

from __future__ import annotations

from statistics import median

from armlab.wire.egm import Packet

__all__ = ["NOMINAL_PERIOD", "Period", "RobotClock"]

NOMINAL_PERIOD = 0.004
"""Cycle time of EGM that is assumed before the first measurement [s]; a real controller has 4.032 ms."""

_LONGEST = 1.0  # s between two packets; a clock that steps further was set
_SAMPLES = 9  # of the first median; later samples are averaged
_TRUSTED = 1.5 * NOMINAL_PERIOD  # s, longest before the first median is complete: one gap must not allow a larger step
_GAIN = 0.02
_NEAR = 0.4  # of the estimate: wider than one tick of a clock in milliseconds, narrower than one skipped cycle
_WRAP_MS = 2**32


class Period:
    """The robot's cycle time, robust against gaps: a median first, then a slow average of the samples near it.

    Until nine samples are there it stays below 1.5 times the nominal: a gap among them must not allow a larger step.

    Attributes
    ----------
    seconds : the estimate, `NOMINAL_PERIOD` before the first sample.
    """

    def __init__(self) -> None:
        self.seconds = NOMINAL_PERIOD
        self._first: list[float] = []

    def add(self, sample: float) -> None:
        """Take one measured cycle time [s]: time between two packets over the difference of their numbers."""
        if len(self._first) < _SAMPLES:
            self._first.append(sample)
            self.seconds = median(self._first)
            if len(self._first) < _SAMPLES:
                self.seconds = min(self.seconds, _TRUSTED)
        elif abs(sample - self.seconds) < _NEAR * self.seconds:
            self.seconds += _GAIN * (sample - self.seconds)


class RobotClock:
    """Differences of robot time: feedBack.time, else the header's tm, else arrival.

    A source that steps back, stands still or jumps by more than 1 s is not used for that step. A tm that is the same in
    two packets is too coarse for the cycle, below 1 ms, and is not used again: its next step would count twice.
    """

    def __init__(self) -> None:
        self._is_coarse = False
        self._last: tuple[int, int | None, int] | None = None  # robot ns, tm ms, arrival ns

    def step(self, packet: Packet, arrival_ns: int) -> float | None:
        """Return the seconds since the previous packet, None for the first.

        Parameters
        ----------
        packet : carries the robot's clocks. arrival_ns : our monotonic clock.
        """
        last, self._last = self._last, (packet.robot_ns, packet.tm_ms, arrival_ns)
        if last is None:
            return None
        robot_ns, tm_ms, arrived = last
        if packet.robot_ns and robot_ns:
            dt = 1e-9 * (packet.robot_ns - robot_ns)
            if 0.0 < dt <= _LONGEST:
                return dt
        if packet.tm_ms is not None and tm_ms is not None and not self._is_coarse:
            dt = 1e-3 * ((packet.tm_ms - tm_ms) % _WRAP_MS)
            self._is_coarse = dt == 0.0
            if 0.0 < dt <= _LONGEST:
                return dt
        return max(1e-9 * (arrival_ns - arrived), 1e-6)
