"""`HandPath`: where a hand leads the arm in lead-through, over time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from armlab.errors import ShapeError
from armlab.robots import Robot

__all__ = ["HandPath"]

_WAVES = 3
_SHARE_OF_RANGE, _SHARE_OF_SPEED = 0.25, 0.1


class HandPath:
    """A joint path over time, smooth between its rows (cubic, continuous velocity), at rest outside of them.

    Parameters
    ----------
    t : (N,) increasing seconds since the stream began, at least two.
    q : (N, n) postures [rad or m].

    Raises
    ------
    ShapeError : when the shapes do not fit, a number is not finite, or the time does not increase.
    """

    def __init__(self, t: np.ndarray, q: np.ndarray) -> None:
        self._t, self._q = np.array(t, dtype=np.float64), np.array(q, dtype=np.float64)
        if self._t.ndim != 1 or self._q.ndim != 2 or len(self._t) != len(self._q) or len(self._t) < 2:
            raise ShapeError(
                f"Expected times (N,) and postures (N, n) with at least two rows, got {self._t.shape} and "
                f"{self._q.shape}. Give one posture per time."
            )
        if not (np.isfinite(self._t).all() and np.isfinite(self._q).all() and (np.diff(self._t) > 0).all()):
            raise ShapeError("Expected finite postures at finite times that increase, got others. Correct the rows.")
        slopes = np.gradient(self._q, self._t, axis=0)
        slopes[[0, -1]] = 0.0
        self._slopes = slopes

    @classmethod
    def random(cls, robot: Robot, seed: int | Sequence[int] = 0, seconds: float = 600.0) -> HandPath:
        """Return a smooth path from the home posture and back, within limits and below a tenth of the speed limits.

        Parameters
        ----------
        robot : for limits. seed : of the path. seconds : its length.
        """
        draw = np.random.default_rng(seed)
        t = np.arange(0.0, seconds + 1e-9, 0.05)
        room = _SHARE_OF_RANGE * np.minimum(robot.q_max - robot.q_home, robot.q_home - robot.q_min) / _WAVES
        q = np.tile(robot.q_home, (len(t), 1))
        for _ in range(_WAVES):
            w = 2.0 * np.pi * np.round(seconds * draw.uniform(0.05, 0.3, robot.n)).clip(1) / seconds
            reach = np.minimum(room, _SHARE_OF_SPEED * robot.qd_max / (_WAVES * w)) * draw.uniform(-1.0, 1.0, robot.n)
            q += reach * (1.0 - np.cos(w * t[:, None]))
        return cls(t, q)

    @property
    def n(self) -> int:
        """Number of joints."""
        return self._q.shape[1]

    def at(self, t: float) -> tuple[np.ndarray, np.ndarray]:
        """Return position and velocity, (n,) each.

        Parameters
        ----------
        t : seconds since the stream began.
        """
        times = self._t
        if not times[0] <= t < times[-1]:
            return self._q[0 if t < times[0] else -1], np.zeros(self.n)
        i = int(np.searchsorted(times, t, side="right")) - 1
        h = times[i + 1] - times[i]
        s = (t - times[i]) / h
        start, end, v0, v1 = self._q[i], self._q[i + 1], h * self._slopes[i], h * self._slopes[i + 1]
        c2, c3 = 3 * (end - start) - 2 * v0 - v1, 2 * (start - end) + v0 + v1
        return start + s * (v0 + s * (c2 + s * c3)), (v0 + s * (2 * c2 + 3 * s * c3)) / h
