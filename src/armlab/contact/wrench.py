"""`Wrench`: an estimated contact wrench with its covariance and what could be seen at all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["INFEASIBLE", "INVALID", "SINGULAR", "STUCK", "TARED", "WEAK", "Wrench"]

INVALID = 1
"""The sample was not finite; the estimate is NaN."""
WEAK = 2
"""Some axis has observability below 0.5: there the prior speaks louder than the torques."""
STUCK = 4
"""Every joint is inside its friction bound: nothing is known but the interval."""
INFEASIBLE = 8
"""No wrench explains the torques inside their bounds: another contact, or a wrong model."""
SINGULAR = 16
"""Without a prior this pose does not determine the wrench; the estimate is NaN."""
TARED = 32
"""Friction was told apart from contact by `Estimator.tare`, and no joint has moved away since."""


@dataclass(frozen=True, slots=True, eq=False)
class Wrench:
    """Wrench [f; m] by the environment on the robot, base axes, at the tool point.

    Attributes
    ----------
    F : (6,) [N, N m]. cov : (6, 6) posterior covariance, with what unknown gains of the torques add to it.
    observability : (6,) 1 - posterior variance / prior variance, in [0, 1], as if the gains were known.
    torque_error : (n,) filtered model minus measured torque [N m]; of "kf", what of it the
        estimate explains. torque_variance : (n,) its variance.
    prior : (6,) prior variances of the unknowns: the wrench, or a force at a known point (then the last three idle).
    flags : bits INVALID, WEAK, STUCK, INFEASIBLE, SINGULAR, TARED.
    active : (n,) joints that tell something; when INFEASIBLE, those that contradict each other.
    interval : (6, 2) guaranteed smallest and largest value per axis, of the method "interval".
    at_point : the contact is at a known point: three unknowns instead of six.
    tared_at : time of the tare that holds [s], or None.
    """

    F: np.ndarray
    cov: np.ndarray
    observability: np.ndarray
    torque_error: np.ndarray
    torque_variance: np.ndarray
    prior: np.ndarray
    flags: int
    active: np.ndarray
    interval: np.ndarray | None = None
    at_point: bool = False
    tared_at: float | None = None

    @property
    def sigma(self) -> np.ndarray:
        """Standard deviation per axis (6,) [N, N m]."""
        return np.sqrt(np.diag(self.cov))

    @property
    def cond(self) -> float:
        """Condition of C_tau^-1/2 J^T C_F^1/2: how unevenly this pose sees the wrench; inf when singular."""
        shares = self._spectrum()[0]
        if not np.isfinite(shares).all():
            return float("nan")
        gains = np.maximum(1.0 / np.clip(shares, 1e-300, 1.0) - 1.0, 0.0)  # squared singular values
        return float(np.sqrt(gains.max() / gains.min())) if gains.min() > 0 else float("inf")

    @property
    def directions(self) -> tuple[np.ndarray, np.ndarray]:
        """Observability (k,) of k orthogonal directions, worst first, and the directions as columns (k, k).

        Directions are in prior-scaled axes, the eigenvectors of ``C_F^-1/2 P C_F^-1/2``; k is 6, or 3 at a known point.
        """
        shares, vectors = self._spectrum()
        return np.maximum(1.0 - shares[::-1], 0.0), vectors[:, ::-1]

    @property
    def hidden(self) -> np.ndarray:
        """Unit direction (k,) in prior-scaled axes that the torques tell least about; NaN for an invalid sample."""
        return self._spectrum()[1][:, -1]

    def _spectrum(self) -> tuple[np.ndarray, np.ndarray]:
        """Return posterior over prior variance (k,), ascending, and its directions as columns."""
        k = 3 if self.at_point else 6
        cov, scale = self.cov[:k, :k], np.sqrt(self.prior[:k])
        if not np.isfinite(cov).all():
            return np.full(k, np.nan), np.full((k, k), np.nan)
        shares, vectors = np.linalg.eigh(cov / np.outer(scale, scale))
        return shares, vectors
