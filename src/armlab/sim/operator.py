"""The operator who pushes the simulated arm: a wrench over guidance time."""

from __future__ import annotations

import numpy as np

from armlab.errors import ShapeError

__all__ = ["Operator"]


class Operator:
    """A wrench at the tool point, piecewise linear over time, zero before the first and after the last row.

    Sign and axes: exerted by the environment on the robot, base axes, about the tool point. A weight of 1 kg is
    ``[0, 0, -9.80665, 0, 0, 0]``.

    Parameters
    ----------
    t : (N,) increasing seconds since guidance began.
    wrench : (N, 6) rows ``[f; m]`` [N, N m].

    Raises
    ------
    ShapeError : when the shapes do not fit, a number is not finite, or the time does not increase.
    """

    def __init__(self, t: np.ndarray, wrench: np.ndarray) -> None:
        self._t = np.array(t, dtype=np.float64)
        self._wrench = np.array(wrench, dtype=np.float64)
        if self._t.ndim != 1 or self._wrench.shape != (len(self._t), 6):
            raise ShapeError(
                f"Expected times (N,) and wrenches (N, 6), got {self._t.shape} and {self._wrench.shape}. "
                "Give one wrench per time."
            )
        bad = np.flatnonzero(~(np.isfinite(self._t) & np.isfinite(self._wrench).all(axis=1)))
        if bad.size:
            raise ShapeError(f"Expected finite times and wrenches, got another value in row {bad[0] + 1}.")
        late = np.flatnonzero(np.diff(self._t) <= 0)
        if late.size:
            raise ShapeError(
                f"Expected times that increase, got {self._t[late[0] + 1]:g} s after {self._t[late[0]]:g} s "
                f"in row {late[0] + 2}."
            )

    @classmethod
    def idle(cls) -> Operator:
        """Return the operator who never touches the arm."""
        return cls(np.zeros(0), np.zeros((0, 6)))

    def at(self, t: float) -> np.ndarray | None:
        """Return the wrench (6,) at guidance time `t`, or None when there is no contact.

        Parameters
        ----------
        t : seconds since guidance began.
        """
        times = self._t
        if not len(times) or t < times[0] or t > times[-1]:
            return None
        i = int(np.searchsorted(times, t, side="right"))
        if i == len(times):
            return self._wrench[-1]
        share = (t - times[i - 1]) / (times[i] - times[i - 1])
        return self._wrench[i - 1] + share * (self._wrench[i] - self._wrench[i - 1])
