"""Motors that move several joints, as in wrists: their inertia and friction act on all of these.

Motor k turns by ``theta_k = c_k q`` (in units of the joint it belongs to), so with the power kept::

    tau = sum_k c_k^T (inertia_k c_k qdd + viscous_k c_k qd + coulomb_k tanh(c_k qd / smooth_speed_k))

No set of links and joint friction has these torques: they must be told apart.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from armlab._numbers import still
from armlab.errors import ShapeError

__all__ = ["CoupledKernel", "CoupledMotors"]


@dataclass(frozen=True, eq=False)
class CoupledMotors:
    """K motors of an arm of n joints.

    Attributes
    ----------
    ratios : (K, n) rows c_k.
    inertia : (K,) [kg m^2]. viscous : (K,) [N m s/rad]. coulomb : (K,) [N m]. smooth_speed : (K,) [rad/s].
    """

    ratios: np.ndarray
    inertia: np.ndarray
    viscous: np.ndarray
    coulomb: np.ndarray
    smooth_speed: np.ndarray

    def __post_init__(self) -> None:
        """Check shapes and freeze."""
        K = len(np.atleast_2d(still(self.ratios, "ratios of coupled motors")))
        for name in ("ratios", "inertia", "viscous", "coulomb", "smooth_speed"):
            values = still(getattr(self, name), f"{name} of coupled motors")
            if (
                values.shape[:1] != (K,)
                or values.ndim != (2 if name == "ratios" else 1)
                or not np.isfinite(values).all()
            ):
                raise ShapeError(f"Expected finite {name} of {K} coupled motors, got shape {values.shape}.")
            object.__setattr__(self, name, values)
        if np.any(self.smooth_speed <= 0):
            raise ShapeError("Expected smooth_speed > 0 of coupled motors, got a value that is not. Make it positive.")

    def torque(self, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        """Return what the motors take of each joint (..., n) [N m] at velocity and acceleration (..., n)."""
        speed = self._turned(qd)
        own = self.inertia * self._turned(qdd) + self.viscous * speed
        return self._spread(own + self.coulomb * np.tanh(speed / self.smooth_speed))

    def inertial(self, qdd: np.ndarray) -> np.ndarray:
        """Return the part of their inertia (..., n) [N m] at acceleration (..., n)."""
        return self._spread(self.inertia * self._turned(qdd))

    def _turned(self, x: np.ndarray) -> np.ndarray:
        return np.sum(
            self.ratios * np.asarray(x, dtype=float)[..., None, :], axis=-1
        )  # not @: rows as alone, bit for bit

    def _spread(self, own: np.ndarray) -> np.ndarray:
        return np.sum(self.ratios * own[..., None], axis=-2)


class CoupledKernel:
    """A kernel of an estimator whose torques are first relieved of what coupled motors take.

    The acceleration is the difference of the velocity to the last sample that was whole, as in the kernel itself.

    Parameters
    ----------
    kernel : with step, run and reset, of a model without the motors. motors : of the model.
    gains : (n,) torque as it is read over true torque.
    """

    def __init__(self, kernel: Any, motors: CoupledMotors, gains: np.ndarray) -> None:
        self._kernel, self._motors, self._gains = kernel, motors, gains
        self._qd: np.ndarray | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._kernel, name)

    def reset(self) -> None:
        """Forget all samples."""
        self._qd = None
        self._kernel.reset()

    def step(self, q: np.ndarray, qd: np.ndarray, tau: np.ndarray, dt: float) -> Any:
        """Take one sample: q, qd, tau (n,), dt [s]."""
        if not np.shape(q) == np.shape(qd) == np.shape(tau):
            return self._kernel.step(q, qd, tau, dt)  # which says what is wrong
        whole = bool(np.isfinite(q).all() and np.isfinite(qd).all() and np.isfinite(tau).all() and np.isfinite(dt))
        if not whole or not dt > 0:
            return self._kernel.step(q, qd, tau, dt)
        last = qd if self._qd is None else self._qd
        self._qd = np.array(qd, dtype=float)
        return self._kernel.step(q, qd, tau - self._gains * self._motors.torque(qd, (qd - last) / dt), dt)

    def run(self, q: np.ndarray, qd: np.ndarray, tau: np.ndarray, dt: np.ndarray) -> Any:
        """Take samples in their order: q, qd, tau (N, n), dt (N,) [s]; the same as steps."""
        if not np.shape(q) == np.shape(qd) == np.shape(tau) == (*np.shape(dt), len(self._gains)):
            return self._kernel.run(q, qd, tau, dt)  # which says what is wrong
        whole = np.isfinite(np.concatenate([q, qd, tau], axis=1)).all(axis=1) & np.isfinite(dt)
        rows = np.flatnonzero(whole & (np.where(whole, dt, 0.0) > 0))
        relieved = np.array(tau, dtype=float)
        if len(rows):
            first = qd[rows[:1]] if self._qd is None else self._qd[None]
            last = np.concatenate([first, qd[rows[:-1]]])
            relieved[rows] -= self._gains * self._motors.torque(qd[rows], (qd[rows] - last) / dt[rows, None])
            self._qd = np.array(qd[rows[-1]], dtype=float)
        return self._kernel.run(q, qd, relieved, dt)
