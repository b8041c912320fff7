"""Friction that depends on more than position and velocity: warmth, load, the direction of the ripple.

Three ways in which a drive departs from `armlab.sim.friction`, each by a knob of `Mismatch`::

    viscous  (1 - warm_up x),             dx/dt = (|F_f qd| / P - x) / 12 min,    P the power at a quarter of full speed
    c        (1 + load_friction |tau| / tau_max)
    phase  + ripple_jump (1 - s) / 2,     s the bristle force over Coulomb friction: from 1 forward to -1 backward
"""

from __future__ import annotations

import numpy as np

from armlab.sim.friction import Friction
from armlab.sim.mismatch import Mismatch
from armlab.sim.truth import Truth

__all__ = ["WornFriction"]

WARM_TIME = 720.0  # s
WARM_SPEED = 0.25  # of the speed limit, at which friction heats the drive to a warmth of 1


class WornFriction(Friction):
    """Friction state of all joints, warmth included.

    Parameters
    ----------
    truth : the parameters.
    mismatch : `warm_up`, `load_friction` and `ripple_jump` are used.
    step : time between two calls of `advance` [s].
    load : (n,) torque of the drives [N m]; read at every step.
    """

    def __init__(self, truth: Truth, mismatch: Mismatch, step: float, load: np.ndarray) -> None:
        super().__init__(truth)
        self._mismatch, self._step, self._load = mismatch, step, load
        self._cold = self._mean.copy(), self._skew.copy()
        coulomb = np.where(self._mean > 0, self._mean, 1.0)
        speed = np.divide(coulomb, truth.viscous, out=np.full_like(coulomb, np.inf), where=truth.viscous > 0)
        self._full = coulomb
        self._power = WARM_SPEED * (1.0 + WARM_SPEED) * coulomb * speed
        self.warmth = np.zeros_like(coulomb)

    def advance(self, dq: np.ndarray, qd: np.ndarray) -> None:
        """Move the bristles by `dq` and warm the drives.

        Parameters
        ----------
        dq : (n,) displacement in this step [rad].
        qd : (n,) velocity of this step [rad/s].
        """
        share = 1.0 + self._mismatch.load_friction * np.abs(self._load) / self._truth.tau_max
        self._mean, self._skew = share * self._cold[0], share * self._cold[1]
        super().advance(dq, qd)
        heat = np.abs((self.bristle + self._viscous * qd) * qd) / self._power
        self.warmth += self._step / WARM_TIME * (heat - self.warmth)
        self._viscous = self._truth.viscous * (1.0 - self._mismatch.warm_up * np.minimum(self.warmth, 1.0))
        forward = np.clip(self.bristle / self._full, -1.0, 1.0)
        self._phase = self._truth.ripple_phase + self._mismatch.ripple_jump * 0.5 * (1.0 - forward)
