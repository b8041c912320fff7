"""Time of the robot: `RobotClock` measures the time between packets, `Period` the cycle time."""

from __future__ import annotations

from collections import deque
from statistics import median

from armlab.bridge.events import Tell, nobody
from armlab.wire.egm import Packet

__all__ = ["NOMINAL_PERIOD", "Period", "RobotClock"]

NOMINAL_PERIOD = 0.004
"""Cycle time of EGM that is assumed before the first measurement [s]; a real controller has 4.032 ms."""

_LONGEST = 1.0  # s between two packets; a clock that steps further was set
_WINDOW = 9  # samples of the median
_TRUSTED = 1.5 * NOMINAL_PERIOD  # s, longest before the first window is complete: one gap is no cycle
_GAIN = 0.02
_NEAR = 0.4  # of the estimate: wider than one tick of a clock in milliseconds, narrower than one skipped cycle
_WRAP_MS = 2**32
_SHORTEST = 2e-4  # s between two packets; those of a burst, or of a clock that is not believed, are no cycles
_AHEAD, _BEHIND = 1e-3, 0.5  # s by which robot time may lead or trail arrival times: jitter, and a network that stood
_STAYS = 10.0  # s: a lag of robot time that stays is no burst, it is a longer way, or a slow clock
_DRIFT = 1e-4  # of crystals
_WRONG, _WRONG_SHARE = 0.02, 0.01  # s, and of the time, that were not believed: less is a first packet that came late


class Period:
    """The robot's cycle time: the median of nine samples, then a slow average; relearnt when it changes.

    Attributes
    ----------
    seconds : the estimate, `NOMINAL_PERIOD` before the first sample.
    """

    def __init__(self) -> None:
        self.seconds = NOMINAL_PERIOD
        self._recent: deque[float] = deque(maxlen=_WINDOW)
        self._learnt = False

    def add(self, sample: float) -> bool:
        """Add the time between two packets over the difference of their numbers [s]; return whether the cycle changed.

        A change shows after five packets: they are the majority of the window then.
        """
        if sample < _SHORTEST:
            return False
        self._recent.append(sample)
        if self._learnt and self._is_near(sample):
            self.seconds += _GAIN * (sample - self.seconds)
            return False
        middle = median(self._recent)
        if not self._learnt:
            self._learnt = len(self._recent) == _WINDOW
            self.seconds = middle if self._learnt else min(middle, _TRUSTED)
            return False
        if self._is_near(middle):
            return False
        self.seconds = middle
        return True

    def _is_near(self, sample: float) -> bool:
        return abs(sample - self.seconds) < _NEAR * self.seconds


class RobotClock:
    """Differences of robot time: feedBack.time, else the header's tm, else arrival; never faster than arrivals allow.

    A source that steps back, stands still or jumps by more than 1 s is not used for that step. A tm that is the same in
    two packets is too coarse for the cycle, below 1 ms, and is not used again: its next step would count twice.
    A reference may move on by no more than `believed`: robot time may lead arrival times, those of the fastest packets,
    by 1 ms, and trail them by 0.5 s, in which a network that stood delivers what waited.

    Parameters
    ----------
    checks_arrival : False for a robot in lockstep, whose time is not ours.
    on_event : called once for each kind of fault.

    Attributes
    ----------
    exact : the last step is of feedBack.time; tm counts milliseconds, and arrivals jitter.
    believed : the last step, cut off where the robot's clock runs ahead of arrivals [s].
    """

    def __init__(self, checks_arrival: bool = True, on_event: Tell = nobody) -> None:
        self._checks_arrival, self._on_event = checks_arrival, on_event
        self.exact = self._is_coarse = False
        self.believed = 0.0
        self._lead = self._cut_off = 0.0  # s of robot time beyond arrival time, and of what was not believed
        self._trails = 0.0  # s for which robot time has trailed
        self._trailed = False
        self._told: set[str] = set()
        self._last: tuple[int, int | None, int] | None = None  # robot ns, tm ms, arrival ns

    def step(self, packet: Packet, arrival_ns: int) -> float | None:
        """Return the seconds since the previous packet, None for the first."""
        last, self._last = self._last, (packet.robot_ns, packet.tm_ms, arrival_ns)
        if last is None:
            return None
        self.exact = False
        arrived = max(1e-9 * (arrival_ns - last[2]), 1e-6)
        claimed = self._claimed(packet, last)
        self.believed = arrived if claimed is None else claimed
        if claimed is not None and self._checks_arrival:
            self.believed = self._check(claimed, arrived)
        return arrived if claimed is None else claimed

    def _check(self, claimed: float, arrived: float) -> float:
        """Return what is believed of a step by the robot's clocks."""
        dt = min(claimed, max(arrived + _AHEAD - self._lead, 1e-6))
        self._cut_off = max(self._cut_off + claimed - dt - _WRONG_SHARE * arrived, 0.0)
        if self._cut_off > _WRONG:
            self._tell(
                "fast",
                f"The robot's clock runs ahead of ours: it claims {1e3 * claimed:.1f} ms between packets that arrived "
                f"{1e3 * arrived:.1f} ms apart. Steps are limited to the time between arrivals.",
            )
        forgotten = min(abs(self._lead), _DRIFT * arrived)
        self._lead -= forgotten if self._lead > 0.0 else -forgotten
        self._lead = max(self._lead + dt - arrived, -_BEHIND)
        self._trails = self._trails + arrived if self._lead < -_WRONG else 0.0
        if self._trails > _STAYS:  # the arrivals now are the fastest ones
            if self._trailed:
                self._tell("slow", "The robot's clock runs behind ours: steps are those of the slower clock.")
            self._lead, self._trails, self._trailed = 0.0, 0.0, True
        return dt

    def _claimed(self, packet: Packet, last: tuple[int, int | None, int]) -> float | None:
        """Return the step by the robot's own clocks, None when neither can be used."""
        robot_ns, tm_ms, _ = last
        if packet.robot_ns and robot_ns:
            dt = 1e-9 * (packet.robot_ns - robot_ns)
            if 0.0 < dt <= _LONGEST:
                self.exact = True
                return dt
            what = "stands still" if dt == 0.0 else f"was set by {dt:+.3f} s"
            self._tell(
                "set" if dt else "still",
                f"The robot's clock {what}. This step is measured by the header's tm or by arrival.",
            )
        if packet.tm_ms is not None and tm_ms is not None and not self._is_coarse:
            dt = 1e-3 * ((packet.tm_ms - tm_ms) % _WRAP_MS)
            self._is_coarse = dt == 0.0
            if 0.0 < dt <= _LONGEST:
                return dt
        return None

    def _tell(self, kind: str, text: str) -> None:
        if kind not in self._told:
            self._told.add(kind)
            self._on_event(text, warn=True)
