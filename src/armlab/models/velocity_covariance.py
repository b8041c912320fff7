"""Variance of the joint torque error over velocity: large near rest, small in motion (TFRT-7651, equations 3 and 4).

exponential:  s_i^2(qd) = (C0_i - Cinf_i) exp(-rate_i |qd_i|) + Cinf_i
step:         s_i^2(qd) = C0_i where |qd_i| < threshold_i, else Cinf_i
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armlab._numbers import check_name, numbers, still
from armlab.errors import ShapeError

__all__ = ["VelocityCovariance", "velocity_covariance"]

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
