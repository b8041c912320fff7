"""`ClockMap`: stamps of another computer's clock on ours."""

from __future__ import annotations

from collections import deque

import numpy as np

__all__ = ["ClockMap"]

_WINDOW = 10_000_000_000  # ns of the running minimum
_BUCKET = 500_000_000  # ns of which the minimum is one point
_STEP = 50_000_000  # ns that a clock was set when it departs further
_LATE_IN_A_ROW = 10  # late by so many readings is a clock set back, not a delay
_DRIFT_SPAN = 3_000_000_000  # ns before a drift is told from the delays
_FASTEST_DRIFT = 1e-3


class ClockMap:
    """Maps the stamps of another clock to ours: the running minimum over 10 s of receive - source stamp, with drift.

    A packet can be late but never early, so the least difference is the offset of the clocks and the least delay.
    A step above 50 ms begins anew.

    Attributes
    ----------
    resets : how often it began anew.
    """

    def __init__(self) -> None:
        self.resets = 0
        self._forget()

    def _forget(self) -> None:
        self._points: deque[tuple[int, int]] = deque()  # (source, offset) of the least offset in each bucket
        self._drift, self._late = 0.0, 0
        self._line: tuple[int, float] = (0, 0.0)  # source stamp and offset there

    def reset(self) -> None:
        """Begin anew: the other clock was set, or its program restarted."""
        self.resets += 1
        self._forget()

    def add(self, source_ns: int, receive_ns: int) -> int:
        """Take one pair of stamps and return the source's on our clock.

        Parameters
        ----------
        source_ns : the other clock. receive_ns : ours.
        """
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
        """Fit a line under the points: their slope, touching the lowest."""
        start, first = self._points[0]
        steps = [(source - start, offset - first) for source, offset in self._points]
        self._drift = 0.0
        if steps[-1][0] >= _DRIFT_SPAN:
            t, d = np.array(steps, dtype=float).T
            slope = float(((t - t.mean()) * (d - d.mean())).sum() / ((t - t.mean()) ** 2).sum())
            self._drift = min(max(slope, -_FASTEST_DRIFT), _FASTEST_DRIFT)
        self._line = (start, first + min(step - self._drift * at for at, step in steps))
