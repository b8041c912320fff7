"""Motion with its spread over time, and the blend of several."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import members, numbers, still
from armlab.errors import ShapeError

if TYPE_CHECKING:
    from armlab.motion.promp import ProMP

__all__ = ["SAME", "MotionBand", "blend"]

SAME = 1e-10  # of the largest eigenvalue: directions that vary less are known
FLOOR = 1e-6  # of the mean variance, for directions in which demonstrations do not differ


@dataclass(frozen=True, eq=False)
class MotionBand:
    """Motion with its spread over N times.

    Attributes
    ----------
    t : (N,) times [s]. y, yd : (N, n) mean position and velocity. cov : (N, n, n) of the position over demonstrations.
    velocity_cov : (N, n, n) of the velocity.
    """

    t: np.ndarray
    y: np.ndarray
    yd: np.ndarray
    cov: np.ndarray
    velocity_cov: np.ndarray

    def __post_init__(self) -> None:
        """Freeze the arrays."""
        for name in ("t", "y", "yd", "cov", "velocity_cov"):
            values = still(getattr(self, name), f"{name} of a band")
            object.__setattr__(self, name, values)

    @property
    def sd(self) -> np.ndarray:
        """Standard deviation of the position (N, n)."""
        return np.sqrt(np.diagonal(self.cov, axis1=1, axis2=2).clip(min=0.0))


def blend(
    primitives: Sequence[ProMP], activation: ArrayLike, t: ArrayLike, *, duration: float | None = None
) -> MotionBand:
    """Return the product of primitives, each to the power of its activation: from one motion into another, or several
    at once where all of them agree.

    ``cov = (sum a_k cov_k^-1)^-1``, ``y = cov sum a_k cov_k^-1 y_k``, of position and velocity together.

    Parameters
    ----------
    primitives : K of them, of n coordinates. activation : (N, K) or (K,), not negative, not all zero at any time.
    t, duration : as of `ProMP.marginal`.

    Raises
    ------
    ShapeError : another number of coordinates or activations, negative ones, none at some time.
    """
    for one in members(primitives, "primitives"):
        if not hasattr(one, "marginal"):
            raise ShapeError(f"Expected primitives as ProMP, got {type(one).__name__}. motion.fit_promp makes them.")
    if len({p.n for p in primitives}) != 1:
        raise ShapeError("Expected primitives of as many coordinates, got others, or none. Fit them to one arm.")
    first = primitives[0]
    times, n = first.times(t, duration), first.n
    given = numbers(activation, "activation", ShapeError)
    if given.shape not in ((len(primitives),), (len(times), len(primitives))):
        raise ShapeError(
            f"Expected activation of shape ({len(times)}, {len(primitives)}) or ({len(primitives)},), got "
            f"{given.shape}."
        )
    a = np.broadcast_to(given, (len(times), len(primitives)))
    if not (np.isfinite(a).all() and a.min() >= 0.0 and (a.sum(axis=1) > 0.0).all()):
        raise ShapeError(
            "Expected activations that are not negative and never all zero, got others. Let them add to 1."
        )
    information, vector = np.zeros((len(times), 2 * n, 2 * n)), np.zeros((len(times), 2 * n))
    for k, primitive in enumerate(primitives):
        mean, spread = _joint(primitive, times, duration)
        inverse = np.linalg.pinv(spread, rcond=SAME, hermitian=True) * a[:, k, None, None]
        information += inverse
        vector += np.einsum("tij,tj->ti", inverse, mean)
    cov = np.linalg.pinv(information, rcond=SAME, hermitian=True)
    mean = np.einsum("tij,tj->ti", cov, vector)
    return MotionBand(times, mean[:, :n], mean[:, n:], cov[:, :n, :n], cov[:, n:, n:])


def _joint(primitive: ProMP, t: np.ndarray, duration: float | None) -> tuple[np.ndarray, np.ndarray]:
    """Return mean (N, 2n) and covariance (N, 2n, 2n) of position and velocity, with a little noise everywhere."""
    rows = np.stack(primitive.kernels(t, duration), axis=1)  # (N, 2, m)
    n, m = primitive.n, len(primitive.centres)
    blocks = primitive.cov.reshape(n, m, n, m)
    spread = np.einsum("tpa,iajb,tqb->tpiqj", rows, blocks, rows, optimize=True).reshape(len(t), 2 * n, 2 * n)
    floor = FLOOR * np.trace(spread, axis1=1, axis2=2)[:, None, None] / (2 * n)
    return (rows @ primitive.mean).reshape(len(t), 2 * n), spread + floor * np.eye(2 * n)
