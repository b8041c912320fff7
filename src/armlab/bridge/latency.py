"""`Latency`: a histogram with fixed bins, from arrival of a packet to its reply."""

from __future__ import annotations

__all__ = ["Latency"]

_BINS = 20_000  # of one microsecond; the last one takes everything longer


class Latency:
    """Times from arrival to reply in bins of 1 us, in constant memory.

    Attributes
    ----------
    count : times counted. longest : the longest [us].
    """

    def __init__(self) -> None:
        self._bins = [0] * _BINS
        self.count = 0
        self.longest = 0.0

    def add(self, nanoseconds: int) -> None:
        """Count one time."""
        self.count += 1
        self._bins[min(max(nanoseconds, 0) // 1000, _BINS - 1)] += 1
        self.longest = max(self.longest, 1e-3 * nanoseconds)

    def percentile(self, percent: float) -> float:
        """Return the time [us] that `percent` of the times do not exceed; NaN when nothing was counted.

        Parameters
        ----------
        percent : from 0 to 100.
        """
        if not self.count:
            return float("nan")
        wanted, seen = percent / 100.0 * self.count, 0
        for microseconds, number in enumerate(self._bins):
            seen += number
            if number and seen >= wanted:
                return min(microseconds + 1.0, self.longest) if microseconds < _BINS - 1 else self.longest
        return self.longest

    def summary(self) -> dict[str, float]:
        """Return p50, p90, p99, p99.9 and max [us]."""
        names = {"p50": 50.0, "p90": 90.0, "p99": 99.0, "p99.9": 99.9}
        return {name: self.percentile(percent) for name, percent in names.items()} | {"max": self.longest}

    def histogram(self) -> dict[str, list[int]]:
        """Return how many times lie below each limit and not below the one before; in the last are all longer ones.

        Keys: "below_us", limits that double from 2 us on, and "count".
        """
        limits = [1 << k for k in range(1, _BINS.bit_length() + 1)]
        counts = [sum(self._bins[before:limit]) for before, limit in zip([0, *limits], limits, strict=False)]
        return {"below_us": limits, "count": counts}
