"""Noise models: torque covariance over velocity, and the noise of momentum estimators.

exponential:  s_i^2(qd) = (C0_i - Cinf_i) exp(-rate_i |qd_i|) + Cinf_i
step:         s_i^2(qd) = C0_i where |qd_i| < threshold_i, else Cinf_i
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armlab._numbers import check_name, numbers, still
from armlab.errors import ShapeError

KINDS = ("exp", "step", "const")


@dataclass(frozen=True, eq=False)
class VelocityCovariance:
    """Diagonal torque covariance as a function of joint velocity; arrays have shape (n,).

    Attributes
    ----------
    kind : "exp", "step" or "const".
    C0, Cinf : variance at rest and at speed [(N m)^2], C0 >= Cinf > 0.
    shape : "exp": decay rate [s/rad]; "step": threshold speed [rad/s]; "const": zeros.
    alpha2 : factor on both, set so that 2-sigma coverage on held-out data is 95.4 %.
    """

    kind: str
    C0: np.ndarray
    Cinf: np.ndarray
    shape: np.ndarray
    alpha2: float = 1.0

    def __post_init__(self) -> None:
        """Check and freeze."""
        check_name(self.kind, "covariance kind", KINDS)
        for name in ("C0", "Cinf", "shape"):
            values = still(getattr(self, name), f"{name} of a covariance")
            object.__setattr__(self, name, values)
            if not np.isfinite(values).all():
                raise ShapeError(f"Expected finite {name} of a torque covariance, got NaN or Inf. Correct it.")
        if np.any(self.shape < 0) or not 0 < self.alpha2 < np.inf:
            raise ShapeError(
                "Expected a decay rate or threshold not below zero and a finite alpha2 above zero, got others or "
                f"alpha2 {self.alpha2:g}. Correct it."
            )
        regular = self.C0.ndim == 1 and self.C0.shape == self.Cinf.shape == self.shape.shape
        if not regular or not np.all(self.Cinf > 0) or not np.all(self.Cinf <= self.C0):
            raise ShapeError(
                f"Expected C0 >= Cinf > 0, both of shape (n,) in (N m)^2, got shapes {self.C0.shape} and "
                f"{self.Cinf.shape}. Give variances, one per joint."
            )

    def variance(self, qd: np.ndarray) -> np.ndarray:
        """Return s^2 (..., n) [(N m)^2] at `qd` (..., n) [rad/s]."""
        speed = np.abs(np.asarray(qd, dtype=float))
        if self.kind == "exp":
            weight = np.exp(-self.shape * speed)
        elif self.kind == "step":
            weight = (speed < self.shape).astype(float)
        else:
            weight = np.zeros_like(speed)
        return self.alpha2 * ((self.C0 - self.Cinf) * weight + self.Cinf)


def velocity_covariance(
    kind: str, C0: np.ndarray, Cinf: np.ndarray, shape: np.ndarray | None = None, alpha2: float = 1.0
) -> VelocityCovariance:
    """Make a torque covariance over velocity.

    Parameters
    ----------
    kind : "exp", "step" or "const".
    C0, Cinf : (n,) variance at rest and at speed [(N m)^2].
    shape : (n,) decay rate [s/rad] or threshold [rad/s]; not used by "const".
    alpha2 : common factor.

    Raises
    ------
    UnknownName : for another kind. ShapeError : when C0 >= Cinf > 0 does not hold, or a number is not finite.
    """
    zeros = np.zeros_like(numbers(C0, "C0 of a covariance", ShapeError))
    return VelocityCovariance(kind, C0, Cinf, zeros if shape is None else shape, alpha2)


# What the momentum estimators of the contact wrench need to know of a robot's torques and velocities.


PRIOR = (20.0, 20.0, 20.0, 2.0, 2.0, 2.0)
"""Standard deviations of a contact wrench before any measurement [N, N m]."""
FORCE_RATES = {
    "smooth": (2.0, 2.0, 2.0, 0.2, 0.2, 0.2),
    "normal": (5.0, 5.0, 5.0, 0.5, 0.5, 0.5),
    "fast": (20.0, 20.0, 20.0, 2.0, 2.0, 2.0),
}
"""How fast a contact wrench wanders, by name [N/sqrt(s), N m/sqrt(s)]."""


@dataclass(frozen=True, eq=False)
class MomentumNoise:
    """Noise of torque and velocity as the momentum estimators see it.

    Attributes
    ----------
    memory : (n,) correlation time of the torque error [s]; its intensity is ``2 s^2 memory``.
    qd_noise : (n,) deviation of the measured velocity [rad/s].
    alpha2_observer, alpha2_kf : factors on the torque covariance, set so that 2-sigma coverage on held-out data is
        95.4 %: of the residual of the observer, and of the wrench of the Kalman filter in free motion.
    """

    memory: np.ndarray
    qd_noise: np.ndarray
    alpha2_observer: float = 1.0
    alpha2_kf: float = 1.0

    def __post_init__(self) -> None:
        """Check and freeze."""
        for name in ("memory", "qd_noise"):
            values = still(getattr(self, name), f"{name} of the momentum noise")
            object.__setattr__(self, name, values)
        memory, noise = self.memory, self.qd_noise
        regular = memory.ndim == 1 and memory.shape == noise.shape and np.isfinite([memory, noise]).all()
        factors = (self.alpha2_observer, self.alpha2_kf)
        if not regular or np.any(memory <= 0) or np.any(noise < 0) or not all(0 < a < np.inf for a in factors):
            raise ShapeError(
                "Expected memory > 0 and qd_noise >= 0, finite and both of shape (n,), and positive factors, got "
                f"shapes {memory.shape} and {noise.shape}, factors {factors}. Give one number per joint."
            )
