"""Mean of rotations."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from armlab import kernels
from armlab._numbers import check_name
from armlab.errors import NotConverged, ShapeError
from armlab.lie import _check

METHODS = ("chordal", "geodesic")
AGREEMENT = 0.1  # of the weights; below, rotations point everywhere
ITERATIONS = 30
CLOSE = 1e-9  # rad: the step is that of Newton's method, so after it the error is of the order of its square


def mean(
    R: ArrayLike, weights: ArrayLike | None = None, method: Literal["chordal", "geodesic"] = "chordal"
) -> np.ndarray:
    """Return the mean of rotations along axis 0.

    The chordal mean minimises ``Σ weight norm(mean - R)²`` (Frobenius): the rotation nearest to the mean matrix. The
    geodesic one minimises ``Σ weight angle(mean, R)²``, by Newton steps from there. Both are the same for rotations
    that lie symmetrically about one, and nearly so for a narrow spread.

    Parameters
    ----------
    R : (N, ..., 3, 3), N ≥ 1.
    weights : (N,) or (N, ...), not negative; equal when None. 0 leaves a rotation out, also one that is missing.
    method : "chordal" or "geodesic".

    Returns
    -------
    (..., 3, 3); NaN where a rotation that counts is missing.

    Raises
    ------
    ShapeError : when one is not a rotation, weights do not fit, or the rotations have no mean: with the singular
        values ``σ`` of the mean matrix and d the sign of its determinant, ``σ₂ + d σ₃ < 0.1``.
    NotConverged : when the geodesic mean is not found (rotations about a half turn apart).
    UnknownName : when the method does not exist.

    Reference: R. Hartley, J. Trumpf, Y. Dai, H. Li, Rotation averaging, Int. J. Computer Vision 103, 2013.
    """
    check_name(method, "mean of rotations", METHODS)
    R = kernels.rotations(R, "R")
    share = shares(weights, R.shape[:-2])
    R = np.where(share[..., None, None] > 0, R, np.eye(3))
    start, sigma = kernels.so3_nearest((share[..., None, None] * R).sum(axis=0))
    agreement = sigma[..., 1] + sigma[..., 2]
    if (agreement < AGREEMENT).any():
        raise ShapeError(
            f"Expected rotations that agree on a mean, got ones that point everywhere ({agreement.min():.2g} of "
            f"the weights agree, {AGREEMENT:g} are needed). Cluster them first."
        )
    return start if method == "chordal" else _geodesic(R, share, start)


def shares(weights: ArrayLike | None, batch: tuple[int, ...]) -> np.ndarray:
    """Return weights (N, ...) that sum to 1 along axis 0, for elements with these leading axes."""
    if not batch or batch[0] == 0:
        raise ShapeError(f"Expected at least one element along axis 0 to take the mean of, got leading axes {batch}.")
    if weights is None:
        return np.full((batch[0], *[1] * (len(batch) - 1)), 1 / batch[0])
    weights = _check.array(weights, (), "weights")
    if weights.shape not in (batch[:1], batch):
        shapes = " or ".join(map(str, dict.fromkeys((batch[:1], batch))))
        raise ShapeError(f"Expected weights of shape {shapes}, got {weights.shape}.")
    weights = weights.reshape(weights.shape + (1,) * (len(batch) - weights.ndim))
    total = weights.sum(axis=0)
    if (weights < 0).any() or not ((total > 0) & (total < np.inf)).all():
        raise ShapeError("Expected finite weights, none negative, with a sum above 0, got others. Use 0 to leave out.")
    return weights / total


def _geodesic(R: np.ndarray, share: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Newton's method: the Hessian of angle²/2 is the symmetric part of the inverse of the left Jacobian."""
    for _ in range(ITERATIONS):
        w = kernels.so3_log(np.swapaxes(mean, -1, -2) @ R)
        gradient = (share[..., None] * w).sum(axis=0)
        hessian = (share[..., None, None] * kernels.so3_left_jacobian_inv(w)).sum(axis=0)
        missing = np.isnan(hessian).any(axis=(-1, -2), keepdims=True)
        step = np.linalg.solve(np.where(missing, np.eye(3), hessian), gradient[..., None])[..., 0]
        mean = mean @ kernels.so3_exp(step)
        if not (np.abs(step) > CLOSE).any():
            return mean
    raise NotConverged(
        f"Expected rotations that are close enough for one geodesic mean, got none after {ITERATIONS} steps. "
        "Take the chordal mean, or cluster them first."
    )
