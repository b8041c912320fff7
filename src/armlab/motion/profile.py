"""A motion of joints in polynomial pieces, with its samples."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import numbers
from armlab.errors import ShapeError
from armlab.motion import _arguments, _piecewise

__all__ = ["PERIOD", "Profile"]

PERIOD = 0.004  # s, of the control loop


@dataclass(frozen=True, eq=False)
class Profile:
    """A motion of n joints in polynomial pieces, ``q(t) = sum_k c_k (t - breaks_i)^k``, and its samples.

    Attributes
    ----------
    breaks : (M + 1,) times between pieces, from 0 [s].
    coefficients : (M, 6, n), [rad/s^k] or [m/s^k].
    dt : time between samples [s]; the last sample is at the end, so the last step may be shorter.
    t : (N,) from 0 to the end [s]. q, qd, qdd : (N, n) there.

    Raises
    ------
    ShapeError : breaks that do not rise, coefficients of another shape, a period that is not above zero.
    """

    breaks: np.ndarray
    coefficients: np.ndarray
    dt: float = PERIOD
    t: np.ndarray = field(init=False)
    q: np.ndarray = field(init=False)
    qd: np.ndarray = field(init=False)
    qdd: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        """Check the pieces, sample them, and freeze everything."""
        breaks, c = (
            np.array(numbers(part, what, ShapeError))
            for part, what in ((self.breaks, "breaks"), (self.coefficients, "coefficients"))
        )
        dt = _arguments.positive(self.dt, "dt [s]")
        steps = np.diff(np.atleast_1d(breaks))
        if c.ndim != 3 or c.shape[1] != 6 or breaks.shape != (len(c) + 1,) or not (steps > 0.0).all() or breaks[0] != 0:
            raise ShapeError(
                f"Expected breaks (M + 1,) that rise from 0 and coefficients (M, 6, n), got {breaks.shape} and "
                f"{c.shape}. The functions of armlab.motion.profiles make them."
            )
        if not np.isfinite(c).all():
            raise ShapeError(
                "Expected finite coefficients, got NaN or Inf. Give durations and rates that an arm can do."
            )
        if not breaks[-1] < dt * _arguments.MOST_SAMPLES:
            raise ShapeError(
                f"Expected less than {_arguments.MOST_SAMPLES} samples, got {breaks[-1]:g} s at dt = {dt:g} s. "
                "Take a longer dt."
            )
        t = np.append(np.arange(0.0, breaks[-1] - 1e-9 * dt, dt), breaks[-1])
        for name, values in zip(("breaks", "coefficients"), (breaks, c)):
            object.__setattr__(self, name, values)
        for name, values in zip(("t", "q", "qd", "qdd"), (t, *_piecewise.evaluate(breaks, c, t))):
            object.__setattr__(self, name, values)
        for name in ("breaks", "coefficients", "t", "q", "qd", "qdd"):
            getattr(self, name).flags.writeable = False

    @property
    def duration(self) -> float:
        """How long it takes [s]."""
        return float(self.breaks[-1])

    @property
    def qd_peak(self) -> np.ndarray:
        """Largest speed of each joint (n,), between samples too."""
        return _piecewise.peaks(self.breaks, self.coefficients)[0]

    @property
    def qdd_peak(self) -> np.ndarray:
        """Largest acceleration of each joint (n,), between samples too."""
        return _piecewise.peaks(self.breaks, self.coefficients)[1]

    def at(self, t: ArrayLike) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return q, qd, qdd (..., n) at any times; before it starts and after it ends the arm rests where it is.

        Parameters
        ----------
        t : (...,) since the start [s].
        """
        t = numbers(t, "t", ShapeError)
        q, qd, qdd = _piecewise.evaluate(self.breaks, self.coefficients, np.clip(t, 0.0, self.duration))
        moving = ((t >= 0.0) & (t <= self.duration))[..., None]
        return q, np.where(moving, qd, 0.0), np.where(moving, qdd, 0.0)

    def slowed(self, qd_max: ArrayLike = np.inf, qdd_max: ArrayLike = np.inf) -> Profile:
        """Return the same path, stretched in time until the limits hold: it touches one of them, or is unchanged.

        ``k = max(1, max |qd| / qd_max, sqrt(max |qdd| / qdd_max))``.

        Parameters
        ----------
        qd_max, qdd_max : a number or (n,).

        Raises
        ------
        ShapeError : limits of another shape, or not above zero.
        """
        n = self.q.shape[1]
        speed, acceleration = _piecewise.peaks(self.breaks, self.coefficients)
        k = max(
            1.0,
            float(np.max(speed / _arguments.joint_limit(qd_max, "qd_max", n))),
            float(np.sqrt(np.max(acceleration / _arguments.joint_limit(qdd_max, "qdd_max", n)))),
        )
        return Profile(*_piecewise.stretched(self.breaks, self.coefficients, k), self.dt)
