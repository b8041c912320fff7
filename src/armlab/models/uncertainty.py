"""Uncertainty of a torque model: velocity-dependent noise, momentum-estimator noise, and parameter covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armlab._display import Shown
from armlab._numbers import check_name, numbers, still
from armlab.errors import ShapeError

# Noise: torque covariance over velocity, and the noise of momentum estimators.
#
#     exponential:  s_i^2(qd) = (C0_i - Cinf_i) exp(-rate_i |qd_i|) + Cinf_i
#     step:         s_i^2(qd) = C0_i where |qd_i| < threshold_i, else Cinf_i


KINDS = ("exp", "step", "const")


@dataclass(frozen=True, eq=False, repr=False)
class VelocityCovariance(Shown):
    """Diagonal torque covariance as a function of joint velocity.

    Attributes
    ----------
    kind : {"exp", "step", "const"}
        Type of dependence on speed.
    C0 : array, shape (n,), (N m)^2
        Variance at rest; at least `Cinf`.
    Cinf : array, shape (n,), (N m)^2
        Variance at high speed; above 0.
    shape : array, shape (n,), s/rad or rad/s
        "exp": decay rate [s/rad]; "step": threshold speed [rad/s]; "const": zeros.
    alpha2 : float
        Factor on both variances, chosen such that 2-sigma intervals cover 95.4 % of held-out data.
    """

    kind: str
    C0: np.ndarray
    Cinf: np.ndarray
    shape: np.ndarray
    alpha2: float = 1.0

    def __post_init__(self) -> None:
        check_name(self.kind, "covariance kind", KINDS)
        for name in ("C0", "Cinf", "shape"):
            values = still(getattr(self, name), f"{name} of a covariance")
            object.__setattr__(self, name, values)
            if not np.isfinite(values).all():
                raise ShapeError(f"Expected finite {name} of a torque covariance, got NaN or Inf. Correct the values.")
        if np.any(self.shape < 0) or not 0 < self.alpha2 < np.inf:
            raise ShapeError(
                "Expected a decay rate or threshold of at least zero and a finite alpha2 above zero, got other values "
                f"or alpha2 {self.alpha2:g}. Correct the values."
            )
        regular = self.C0.ndim == 1 and self.C0.shape == self.Cinf.shape == self.shape.shape
        if not regular or not np.all(self.Cinf > 0) or not np.all(self.Cinf <= self.C0):
            raise ShapeError(
                f"Expected C0 >= Cinf > 0, both of shape (n,) in (N m)^2, got shapes {self.C0.shape} and "
                f"{self.Cinf.shape}. Pass variances, one per joint."
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
    """Return a torque covariance as a function of velocity.

    Parameters
    ----------
    kind : "exp", "step" or "const".
    C0, Cinf : (n,) variance at rest and at high speed [(N m)^2].
    shape : (n,) decay rate [s/rad] or threshold [rad/s]; not used by "const".
    alpha2 : common factor.

    Raises
    ------
    UnknownName : unknown `kind`.
    ShapeError : if C0 >= Cinf > 0 does not hold, or a number is not finite.
    """
    zeros = np.zeros_like(numbers(C0, "C0 of a covariance", ShapeError))
    return VelocityCovariance(kind, C0, Cinf, zeros if shape is None else shape, alpha2)


# Noise of torques and velocities for the momentum estimators of the contact wrench.


PRIOR = (20.0, 20.0, 20.0, 2.0, 2.0, 2.0)
"""Prior standard deviations of a contact wrench before any measurement [N, N m]."""
FORCE_RATES = {
    "smooth": (2.0, 2.0, 2.0, 0.2, 0.2, 0.2),
    "normal": (5.0, 5.0, 5.0, 0.5, 0.5, 0.5),
    "fast": (20.0, 20.0, 20.0, 2.0, 2.0, 2.0),
}
"""Random-walk intensity of a contact wrench by name [N/sqrt(s), N m/sqrt(s)]."""


@dataclass(frozen=True, eq=False)
class MomentumNoise:
    """Noise of torque and velocity for the momentum estimators.

    `memory`: (n,) correlation time of the torque error [s]; its intensity is ``2 s^2 memory``. `qd_noise`: (n,)
    standard deviation of the measured velocity [rad/s]. `alpha2_observer`, `alpha2_kf`: factors on the torque
    covariance for a 2-sigma coverage of 95.4 % on held-out data. The observer's factor is calibrated on the observer
    residual. The filter's factor is at least 1 and is calibrated on its wrench estimate after a known wrench is added
    to the torques.
    """

    memory: np.ndarray
    qd_noise: np.ndarray
    alpha2_observer: float = 1.0
    alpha2_kf: float = 1.0

    def __post_init__(self) -> None:
        for name in ("memory", "qd_noise"):
            values = still(getattr(self, name), f"{name} of the momentum noise")
            object.__setattr__(self, name, values)
        memory, noise = self.memory, self.qd_noise
        regular = memory.ndim == 1 and memory.shape == noise.shape and np.isfinite([memory, noise]).all()
        factors = (self.alpha2_observer, self.alpha2_kf)
        if not regular or np.any(memory <= 0) or np.any(noise < 0) or not all(0 < a < np.inf for a in factors):
            raise ShapeError(
                "Expected memory > 0 and qd_noise >= 0, finite and both of shape (n,), and positive factors, got "
                f"shapes {memory.shape} and {noise.shape}, factors {factors}. Pass one number per joint."
            )


# Covariance of the parameters. Its effect on the torque grows as a motion departs from the identification motion:
#
#     var(tau_i) = w_i C w_i^T,   w_i the row of the regressor and of the friction of joint i


OF_FRICTION = 7  # parameters per joint


@dataclass(frozen=True, eq=False)
class ParameterCovariance:
    """Covariance of the identified parameters for given gains, including drift until the next log.

    The estimator adds the torque variance that exceeds the `mean` (n,) [(N m)^2] in the identification motion, because
    the torque covariance already contains the mean. `columns`: (P,) index of each parameter among the columns of the
    links (10 n), of the rotors (n), and of the friction of each joint (7 n): viscous, Coulomb of either direction,
    offset, Stribeck, root, load. `lower`: (P (P + 1) / 2,) lower triangle of the covariance, row by row.
    """

    columns: np.ndarray
    lower: np.ndarray
    mean: np.ndarray

    def __post_init__(self) -> None:
        columns, lower = still(self.columns, "parameter columns"), still(self.lower, "a parameter covariance")
        mean, P = still(self.mean, "torque variances"), columns.size
        if not np.all((mean >= 0) & (mean < np.inf)) or mean.ndim != 1:
            raise ShapeError(
                "Expected finite torque variances >= 0, one per joint, got other values. Identify the model again."
            )
        if columns.shape != (P,) or lower.shape != (P * (P + 1) // 2,) or not np.isfinite(lower).all():
            raise ShapeError(
                f"Expected P columns and P (P + 1) / 2 finite numbers of their covariance, got shapes {columns.shape} "
                f"and {lower.shape}. Identify the model again."
            )
        object.__setattr__(self, "columns", columns)
        object.__setattr__(self, "lower", lower)
        object.__setattr__(self, "mean", mean)

    @property
    def cov(self) -> np.ndarray:
        """Covariance (P, P)."""
        half = np.zeros((self.columns.size,) * 2)
        half[np.tril_indices(len(half))] = self.lower
        return half + np.tril(half, -1).T

    def kernel_rows(self, scale: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return columns (n, W), covariances (n, W, W) and means (n,) per joint; `scale`: link-parameter factor."""
        n = len(self.mean)
        columns, cov = self.columns.astype(int), self.cov
        weight = np.where(columns < 10 * n, scale, 1.0)
        cov = cov * np.outer(weight, weight)
        links, drives = columns < 10 * n, columns >= 11 * n
        owner = np.where(links, columns // 10, np.where(drives, (columns - 11 * n) // OF_FRICTION, columns - 10 * n))
        kept = [np.flatnonzero(np.where(links, owner >= i, owner == i)) for i in range(n)]
        width = max(map(len, kept))
        where, blocks = np.full((n, width), -1.0), np.zeros((n, width, width))
        for i, own in enumerate(kept):
            size = len(own)
            where[i, :size] = np.where(drives[own], 11 * n + (columns[own] - 11 * n) % OF_FRICTION, columns[own])
            blocks[i, :size, :size] = cov[np.ix_(own, own)]
        return where, blocks, self.mean
