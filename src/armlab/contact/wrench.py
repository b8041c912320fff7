"""`Wrench`: an estimated contact wrench with its covariance and what could be seen at all."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite

import numpy as np

__all__ = ["INVALID", "WEAK", "Wrench", "flags_of"]

INVALID = 1  # the sample was not finite; the estimate is NaN
WEAK = 2  # some axis has observability below 0.5: there the prior speaks louder than the torques
WEAK_BELOW = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Wrench:
    """Wrench [f; m] by the environment on the robot, base axes, at the tool point.

    Attributes
    ----------
    F : (6,) [N, N m]. cov : (6, 6) posterior covariance.
    observability : (6,) 1 - posterior variance / prior variance, in [0, 1].
    torque_error : (n,) filtered model minus measured torque [N m]. torque_variance : (n,) its variance.
    prior : (6,) prior variances.
    flags : bits INVALID and WEAK.
    """

    F: np.ndarray
    cov: np.ndarray
    observability: np.ndarray
    torque_error: np.ndarray
    torque_variance: np.ndarray
    prior: np.ndarray
    flags: int

    @property
    def sigma(self) -> np.ndarray:
        """Standard deviation per axis (6,) [N, N m]."""
        return np.sqrt(np.diag(self.cov))

    @property
    def cond(self) -> float:
        """Condition of C_tau^-1/2 J^T C_F^1/2: how unevenly this pose sees the wrench; inf when singular."""
        if self.flags & INVALID:
            return float("nan")
        scale = np.sqrt(self.prior)
        shares = np.clip(np.linalg.eigvalsh(self.cov / np.outer(scale, scale)), 1e-300, 1.0)
        gains = np.maximum(1.0 / shares - 1.0, 0.0)  # squared singular values
        return float(np.sqrt(gains.max() / gains.min())) if gains.min() > 0 else float("inf")

    @property
    def hidden(self) -> np.ndarray:
        """Unit direction (6,) in prior-scaled axes that the torques tell least about; NaN for an invalid sample."""
        if self.flags & INVALID:
            return np.full(6, np.nan)
        scale = np.sqrt(self.prior)
        return np.linalg.eigh(self.cov / np.outer(scale, scale))[1][:, -1]


def flags_of(F: np.ndarray, observability: np.ndarray) -> int:
    """Return the flags of one estimate: F (6,), observability (6,)."""
    if not isfinite(F[0]):
        return INVALID
    # Plain Python on six numbers: NumPy's reductions cost more here than the whole estimate, above all in cold caches.
    return WEAK if min(observability.tolist()) < WEAK_BELOW else 0
