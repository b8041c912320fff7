"""What the simulated controller counts about its peer: starved cycles, queue depth, drops by kind, round trips."""

from __future__ import annotations

from collections import Counter, deque
from typing import Any, NamedTuple

import numpy as np

__all__ = ["Event", "Statistics"]

_WARM_UP = 1.0  # seconds left out of the round trips: a peer's first reply may be slow
_KEPT = 100_000  # newest times kept for the quantiles: memory does not grow in a long run


class Event(NamedTuple):
    """Something that the controller's event log would show.

    Attributes
    ----------
    t : robot time [s]. task : the robot. number : ABB's event number, 0 where there is none. text : in words.
    """

    t: float
    task: str
    number: int
    text: str

    def __str__(self) -> str:
        return f"{self.t:.3f} s {self.task} {self.number or '-'} {self.text}"


class Statistics:
    """Counters of one motion task."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.drops: Counter[str] = Counter()
        self.queue: Counter[int] = Counter()
        self.age: Counter[int] = Counter()
        self.events: deque[Event] = deque(maxlen=1000)
        self._round_trips: deque[float] = deque(maxlen=_KEPT)
        self._wake_ups: deque[float] = deque(maxlen=_KEPT)

    def trip(self, seconds: float, uptime: float) -> None:
        """Note one round trip.

        Parameters
        ----------
        seconds : from just before sending a packet to the kernel's receive stamp of its reply.
        uptime : robot time at which it was measured; the first second does not count.
        """
        if uptime > _WARM_UP:
            self._round_trips.append(seconds)

    def late(self, seconds: float) -> None:
        """Note how late this process woke up for a cycle.

        Parameters
        ----------
        seconds : behind the schedule.
        """
        self._wake_ups.append(seconds)

    def as_dict(self) -> dict[str, Any]:
        """Return everything as plain numbers, for a JSON file; times in microseconds."""
        return {
            "counts": dict(sorted(self.counts.items())),
            "drops": dict(sorted(self.drops.items())),
            "queue_depth": {str(k): v for k, v in sorted(self.queue.items())},
            "reference_age": {str(k): v for k, v in sorted(self.age.items())},
            "round_trip_us": _quantiles(self._round_trips),
            "wake_up_late_us": _quantiles(self._wake_ups),
            "events": [event._asdict() for event in self.events],
        }

    def line(self) -> str:
        """Return the summary as one line."""
        trips = _quantiles(self._round_trips)
        text = ", ".join(f"{self.counts[name]} {name}" for name in ("packets", "replies", "starved", "sessions"))
        if self.drops:
            text += f", dropped: {', '.join(f'{count} {kind}' for kind, count in sorted(self.drops.items()))}"
        if trips:
            text += f", round trip p50 {trips['p50']:.0f} us, p99 {trips['p99']:.0f} us, max {trips['max']:.0f} us"
        return text


def _quantiles(seconds: deque[float]) -> dict[str, float]:
    """Return p50, p90, p99, p99.9 and max in microseconds; nothing for no data."""
    if not seconds:
        return {}
    names, shares = ("p50", "p90", "p99", "p99.9", "max"), (0.5, 0.9, 0.99, 0.999, 1.0)
    return {name: round(1e6 * float(value), 1) for name, value in zip(names, np.quantile(seconds, shares))}
