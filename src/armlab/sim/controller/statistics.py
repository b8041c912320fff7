"""Statistics on the peer of the simulated controller, and the event log of one motion task."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from armlab.wire.egm import Drop

_WARM_UP = 1.0  # s; excluded from the timing statistics, because a peer's first replies may be slow
_KEPT = 100_000  # number of most recent times used for the quantiles


class ControllerEvent(NamedTuple):
    """Entry of the controller's event log: robot time [s], robot, ABB's event number (0: none), text."""

    t: float
    task: str
    number: int
    text: str

    def __str__(self) -> str:
        return f"{self.t:.3f} s {self.task} {self.number or '-'} {self.text}"


class Statistics:
    """Counters of one motion task.

    A starved cycle is a cycle that finds the queue empty. Overtaken replies were replaced by newer replies. Skipped
    cycles are cycles without a packet; overruns are skipped cycles caused by this process. Missed packets had no valid
    reply within one period. Duplicates repeat the number of the previous reply. The age of a reply is the number of
    cycles from its packet to its use, at least 1. Times, misses and overruns exclude the first second, except for the
    first round trip, which is reported separately.
    """

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.drops: Counter[str] = Counter()
        self.mtypes: Counter[int] = Counter()
        self.queue: Counter[int] = Counter()
        self.age: Counter[int] = Counter()
        self.last_age = 0
        self.rapid: dict[str, float] = {}
        self.external: dict[str, float] = {}
        self.events: deque[ControllerEvent] = deque(maxlen=1000)
        self._first_trip: float | None = None
        self._round_trips: deque[float] = deque(maxlen=_KEPT)
        self._wake_ups: deque[float] = deque(maxlen=_KEPT)
        self._work: deque[float] = deque(maxlen=_KEPT)

    def trip(self, seconds: float, uptime: float) -> None:
        """Record a round-trip time [s], from just before sending to the kernel's time stamp of the reply."""
        if self._first_trip is None:
            self._first_trip = seconds
        if uptime > _WARM_UP:
            self._round_trips.append(seconds)

    def miss(self, uptime: float) -> None:
        """Count a packet without a valid reply within one period."""
        self.counts["missed"] += uptime > _WARM_UP

    def record_reply(self, rapid_data: np.ndarray | None, rapid_digital: bool | None, q_ext: np.ndarray | None) -> None:
        """Record the RAPID values and external-axis references [rad] of a reply; None means not sent."""
        for name, values, kept in (("RAPID data", rapid_data, self.rapid), ("external axes", q_ext, self.external)):
            if values is not None:
                self.counts[name] += 1
                kept |= {str(k): value for k, value in enumerate(values.tolist(), start=1)}
        if rapid_digital is not None:
            self.counts["RAPID digital"] += 1
            self.rapid["digital"] = float(rapid_digital)

    def late(self, seconds: float, uptime: float) -> None:
        """Record the wake-up latency of this process [s]."""
        if uptime > _WARM_UP:
            self._wake_ups.append(seconds)

    def worked(self, seconds: float, overruns: int, uptime: float) -> None:
        """Record the processor time of a cycle [s] and the number of cycles skipped because of it."""
        if uptime > _WARM_UP:
            self._work.append(seconds)
            self.counts["overruns"] += overruns

    def as_dict(self) -> dict[str, Any]:
        """Return all statistics as numbers for JSON, with times in microseconds."""
        first = {} if self._first_trip is None else {"first": round(1e6 * self._first_trip, 1)}
        return {
            "counts": {name: count for name, count in sorted(self.counts.items()) if count},
            "drops": dict(sorted(self.drops.items())),
            "mtypes": {str(k): v for k, v in sorted(self.mtypes.items())},
            "queue_depth": {str(k): v for k, v in sorted(self.queue.items())},
            "reference_age": {str(k): v for k, v in sorted(self.age.items())} | {"last": self.last_age},
            "round_trip_us": first | _quantiles(self._round_trips),
            "wake_up_late_us": _quantiles(self._wake_ups),
            "work_us": _quantiles(self._work),
            "rapid": self.rapid,
            "external_axes": self.external,
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

    def text(self) -> str:
        """Return all statistics except the events as lines of text, with times in microseconds."""
        values = self.as_dict()
        values.pop("events")
        width = max(map(len, values))
        return "\n".join(
            f"  {name.replace('_', ' '):{width}}  "
            + (", ".join(f"{key}: {value:g}" for key, value in found.items()) or "nothing")
            for name, found in values.items()
        )


def _quantiles(seconds: deque[float]) -> dict[str, float]:
    """Return the quantiles p50, p90, p99, p99.9 and max [us], or an empty dict if there are no data."""
    if not seconds:
        return {}
    names, shares = ("p50", "p90", "p99", "p99.9", "max"), (0.5, 0.9, 0.99, 0.999, 1.0)
    return {name: round(1e6 * float(value), 1) for name, value in zip(names, np.quantile(seconds, shares))}


class EventLog:
    """Event log of a robot, which reports events and the first dropped datagram of each kind per session."""

    def __init__(self, task: str, statistics: Statistics, on_event: Callable[[ControllerEvent], None] | None) -> None:
        self._task, self._statistics, self._on_event = task, statistics, on_event
        self.begin()

    def begin(self) -> None:
        """Begin a session, in which each kind of dropped datagram is reported again."""
        self._told: set[str] = set()

    def tell(self, uptime: float, number: int, text: str) -> None:
        """Record and report one event at a robot time [s]."""
        event = ControllerEvent(round(uptime, 6), self._task, number, text)
        self._statistics.events.append(event)
        if self._on_event:
            self._on_event(event)

    def drop(self, uptime: float, drop: Drop, data: bytes) -> None:
        """Count an invalid datagram and report the first of its kind."""
        self._statistics.drops[drop.reason] += 1
        if drop.reason not in self._told:
            self._told.add(drop.reason)
            begin = data[:32].hex(" ")
            self.tell(uptime, 0, f"dropped a datagram, {drop.reason}: {drop.detail}; first bytes {begin}")
