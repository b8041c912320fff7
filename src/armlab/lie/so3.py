"""Rotations SO(3) as arrays (..., 3, 3) and rotation vectors w (..., 3) [rad].

All functions accept any leading axes and preserve them. NaN inputs give NaN results.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from armlab import kernels
from armlab._numbers import check_name
from armlab.errors import NotConverged, ShapeError
from armlab.lie import arguments

__all__ = [
    "angle", "angle_about", "exp", "from_axis_angle", "hat", "interpolate", "is_rotation", "left_jacobian",
    "left_jacobian_inv", "log", "mean", "orthonormalise", "project", "skew_part", "to_axis_angle", "vee", "xy_angle",
]  # fmt: skip

ROTATION_TOLERANCE = arguments.ROTATION_TOLERANCE
"""Largest accepted entry of |RᵀR - I| of a rotation; rounding to six decimals causes errors of up to 2e-6.

Use `project` for larger errors.
"""
SKEW_TOLERANCE = 1e-9
ONE_NEAREST = 1e-9
NEGLIGIBLE = 1e-9  # largest entry of |RᵀR - I| for which a rotation is left unchanged

UNDEFINED = 1e-13  # length below which a direction is lost to rounding

METHODS = ("chordal", "geodesic")
AGREEMENT = 0.1  # smallest σ₂ + d σ₃ of the mean matrix; below it, the rotations are too scattered for a mean
ITERATIONS = 30
CLOSE = 1e-9  # rad; the error after a Newton step of this size is of the order of its square


def hat(w: ArrayLike) -> np.ndarray:
    """Return the skew matrix (..., 3, 3) of a vector: ``hat(w) x = w × x``.

    Parameters
    ----------
    w : (..., 3) vector.
    """
    w = arguments.array(w, (3,), "w")
    W = np.zeros((*w.shape, 3))
    flat = W.reshape(*w.shape[:-1], 9)
    flat[..., 7:1:-5] = w[..., :2]
    flat[..., 3] = w[..., 2]
    W -= W.swapaxes(-1, -2).copy()
    return W


def vee(W: ArrayLike) -> np.ndarray:
    """Return the vector (..., 3) of a skew matrix: ``vee(hat(w)) = w``.

    Parameters
    ----------
    W : (..., 3, 3), skew to 1e-9 of its largest entry.

    Raises
    ------
    ShapeError : W is not skew; for a rotation use `log`.
    """
    W = arguments.array(W, (3, 3), "W")
    off = np.abs(W + np.swapaxes(W, -1, -2)).max(axis=(-1, -2))
    if (off > SKEW_TOLERANCE * np.abs(W).max(axis=(-1, -2))).any():
        raise ShapeError(
            f"Expected a skew matrix (W = -W^T), got max|W + W^T| = {np.nanmax(off):.3g}. "
            "Use log for a rotation, and skew_part for a nearly skew matrix."
        )
    return np.stack([W[..., 2, 1], W[..., 0, 2], W[..., 1, 0]], axis=-1)


def skew_part(M: ArrayLike) -> np.ndarray:
    """Return the skew part (..., 3, 3) of a matrix: ``(M - Mᵀ) / 2``.

    Parameters
    ----------
    M : (..., 3, 3).
    """
    M = arguments.array(M, (3, 3), "M")
    return (M - np.swapaxes(M, -1, -2)) / 2


def exp(w: ArrayLike, out: np.ndarray | None = None) -> np.ndarray:
    """Return the rotation (..., 3, 3) about w by the angle θ = abs(w).

    ``I + sin θ/θ hat(w) + 2 sin²(θ/2)/θ² hat(w)²``.

    Parameters
    ----------
    w : (..., 3) rotation vector [rad].
    out : (..., 3, 3) array for the result; default: newly allocated.
    """
    return kernels.so3_exp(w, out)


def log(R: ArrayLike, out: np.ndarray | None = None) -> np.ndarray:
    """Return the rotation vector (..., 3) [rad] of minimum length: ``exp(log(R)) = R``, abs(log(R)) ≤ π.

    Computing the rotation vector from the quaternion (w, v), ``2 atan2(abs(v), w) v/abs(v)``, preserves full precision
    from 1e-300 rad to a half turn. At a half turn, the first non-zero component is positive.

    Parameters
    ----------
    R : (..., 3, 3) rotation.
    out : (..., 3) array for the result; default: newly allocated.

    Raises
    ------
    ShapeError : R is not a rotation within `ROTATION_TOLERANCE`.
    """
    return kernels.so3_log(R, out)


def is_rotation(R: ArrayLike, tolerance: float = ROTATION_TOLERANCE) -> np.ndarray:
    """Return whether each matrix is a rotation, ``RᵀR = I`` and ``det R > 0``: (...) bool, False for NaN and infinity.

    Parameters
    ----------
    R : (..., 3, 3).
    tolerance : largest accepted entry of ``abs(RᵀR - I)``.

    Raises
    ------
    ShapeError : wrong shape, or a negative or invalid tolerance.
    """
    R, tolerance = arguments.array(R, (3, 3), "R"), arguments.tolerance(tolerance)
    R = np.where(np.isfinite(R).all(axis=(-1, -2), keepdims=True), R, 0.0)
    off = np.abs(np.swapaxes(R, -1, -2) @ R - np.eye(3)).max(axis=(-1, -2))
    a, b, c, d, e, f, g, h, i = R.reshape(-1, 9).T
    determinant = a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g)
    return (off <= tolerance) & (determinant.reshape(off.shape) > 0)


def orthonormalise(R: ArrayLike, tolerance: float = ROTATION_TOLERANCE) -> np.ndarray:
    """Project rounded rotations onto SO(3).

    Matrices that are orthonormal to 1e-9 and matrices that are not rotations (see `is_rotation`) are left unchanged.

    Parameters
    ----------
    R : (..., 3, 3).
    tolerance : largest entry of ``abs(RᵀR - I)`` that counts as rounding.

    Raises
    ------
    ShapeError : wrong shape, or a negative or invalid tolerance.
    """
    R = arguments.array(R, (3, 3), "R")
    precise = is_rotation(R, NEGLIGIBLE)
    if precise.all() or not (rounded := is_rotation(R, tolerance) & ~precise).any():
        return R
    R = R.copy()
    R[rounded] = nearest(R[rounded])[0]
    return R


def project(M: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Return the rotation nearest to a matrix, ``U diag(1, 1, det UVᵀ) Vᵀ`` of ``M = U S Vᵀ``, and its distance.

    Parameters
    ----------
    M : (..., 3, 3) matrix.

    Returns
    -------
    R : (..., 3, 3) rotation that minimises the Frobenius norm of ``R - M``.
    distance : (...) minimum of this norm.

    Raises
    ------
    ShapeError : an infinite entry, or the nearest rotation is not unique (the two smallest singular values are both 0,
        or are equal and the determinant is negative).
    """
    M = arguments.array(M, (3, 3), "M")
    R, sigma = nearest(M)
    ambiguous = sigma[..., 1] + sigma[..., 2] <= ONE_NEAREST * sigma[..., 0]
    if ambiguous.any():
        raise ShapeError(
            f"Expected matrices with a unique nearest rotation, got singular values {abs(sigma[ambiguous][0])}."
        )
    if (np.isinf(M).any(axis=(-1, -2)) & ~np.isnan(M).any(axis=(-1, -2))).any():
        raise ShapeError("Expected finite matrices, got an infinite entry.")
    return R, np.linalg.norm(R - M, axis=(-1, -2))


def nearest(M: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rotation nearest to M = U S Vᵀ, and ``σ₁, σ₂, d σ₃`` with d = det UVᵀ; NaN if M is not finite.

    ``σ₂ + d σ₃`` measures how well the rotation is determined; at 0, the rotation is not unique.
    """
    missing = np.asarray(~np.isfinite(M).all(axis=(-1, -2), keepdims=True))
    M = np.where(missing, np.eye(3), M)
    U, sigma, Vt = np.linalg.svd(M)
    d = np.sign(np.linalg.det(U @ Vt))
    U[..., 2] *= d[..., None]
    sigma[..., 2] *= d
    R = U @ Vt
    R = R @ (1.5 * np.eye(3) - 0.5 * np.swapaxes(R, -1, -2) @ R)
    # A Newton step removes the rounding error of the SVD: (tr S I - S) w = vee(A - A^T), A = R^T M, S = sym A.
    A = np.swapaxes(R, -1, -2) @ M
    H = np.trace(A, axis1=-2, axis2=-1)[..., None, None] * np.eye(3) - (A + np.swapaxes(A, -1, -2)) / 2
    off = np.stack([A[..., 2, 1] - A[..., 1, 2], A[..., 0, 2] - A[..., 2, 0], A[..., 1, 0] - A[..., 0, 1]], axis=-1)
    one = sigma[..., 1:].sum(axis=-1) > ONE_NEAREST * sigma[..., 0]
    H = np.where(one[..., None, None], H, np.eye(3))
    R = np.where(one[..., None, None], R @ kernels.so3_exp(np.linalg.solve(H, off[..., None])[..., 0]), R)
    return np.where(missing, np.nan, R), np.where(missing[..., 0], np.nan, sigma)


def left_jacobian(w: ArrayLike, out: np.ndarray | None = None) -> np.ndarray:
    """Return J (..., 3, 3) with ``exp(w + dw) = exp(J dw) exp(w)``.

    ``I + (1 - cos θ)/θ² hat(w) + (θ - sin θ)/θ³ hat(w)²``; the right Jacobian is ``left_jacobian(-w)``.

    Parameters
    ----------
    w : (..., 3) rotation vector [rad].
    out : (..., 3, 3) array for the result; default: newly allocated.
    """
    return kernels.so3_left_jacobian(w, out)


def left_jacobian_inv(w: ArrayLike, out: np.ndarray | None = None) -> np.ndarray:
    """Return the inverse (..., 3, 3) of `left_jacobian`: ``I - hat(w)/2 + (1 - θ/2 cot(θ/2))/θ² hat(w)²``.

    Parameters
    ----------
    w : (..., 3) rotation vector shorter than 2π [rad].
    out : (..., 3, 3) array for the result; default: newly allocated.
    """
    return kernels.so3_left_jacobian_inv(w, out)


def interpolate(R_a: ArrayLike, R_b: ArrayLike, s: ArrayLike, out: np.ndarray | None = None) -> np.ndarray:
    """Interpolate from a to b about a fixed axis at constant speed: ``R_a exp(s log(R_aᵀ R_b))`` (..., 3, 3).

    Both ends are exact, and the result is equivalent to `quaternion.slerp`. Values of s outside [0, 1] extrapolate.

    Parameters
    ----------
    R_a, R_b : (..., 3, 3) rotations; leading axes broadcast with those of s.
    s : (...) path parameter, 0 at a and 1 at b.
    out : (..., 3, 3) array for the result; default: newly allocated.

    Raises
    ------
    ShapeError : an argument is not a rotation within `ROTATION_TOLERANCE`.
    """
    return kernels.so3_interpolate(R_a, R_b, s, out)


def angle(R_a: ArrayLike, R_b: ArrayLike) -> np.ndarray:
    """Return the angle (...) in [0, π] [rad] between two rotations: ``abs(log(R_aᵀ R_b))``, 0 for equal rotations.

    Parameters
    ----------
    R_a, R_b : (..., 3, 3) rotations; leading axes broadcast.

    Raises
    ------
    ShapeError : an argument is not a rotation within `ROTATION_TOLERANCE`.
    """
    return kernels.so3_angle(R_a, R_b)[()]


def xy_angle(R_a: ArrayLike, R_b: ArrayLike) -> np.ndarray:
    """Return the heading of b in a: the angle of b's x axis in a's xy plane, ``atan2(R_10, R_00)`` of ``R_aᵀ R_b``.

    The result (...) is in (-π, π] [rad], positive about a's z axis, and NaN if this axis is parallel to b's x axis.

    Parameters
    ----------
    R_a, R_b : (..., 3, 3) rotations; leading axes broadcast.

    Raises
    ------
    ShapeError : an argument is not a rotation within `ROTATION_TOLERANCE`.
    """
    R_a, R_b = kernels.rotations(R_a, "R_a"), kernels.rotations(R_b, "R_b")
    arguments.broadcasts(R_a=(R_a, 2), R_b=(R_b, 2))
    x = (np.swapaxes(R_a, -1, -2) @ R_b[..., :1])[..., 0]
    return _turn(x[..., 1], x[..., 0])


def angle_about(R_a: ArrayLike, R_b: ArrayLike, axis: ArrayLike) -> np.ndarray:
    """Return the rotation angle of b relative to a about an axis: ``2 atan2(axis · v, w)`` of ``R_aᵀ R_b``.

    This is the twist of the swing-twist decomposition; the swing is a rotation about a perpendicular axis. For a pure
    rotation about z, the result equals `xy_angle`. The result (...) is in (-π, π] [rad], positive about the axis, and
    NaN if the swing is a half turn, because the twist is then undefined.

    Parameters
    ----------
    R_a, R_b : (..., 3, 3) rotations; leading axes broadcast with those of the axis.
    axis : (..., 3) axis in frame a, of any non-zero length.

    Raises
    ------
    ShapeError : an argument is not a rotation within `ROTATION_TOLERANCE`, or the axis has length 0.
    """
    R_a, R_b, axis = kernels.rotations(R_a, "R_a"), kernels.rotations(R_b, "R_b"), _direction(axis)
    arguments.broadcasts(R_a=(R_a, 2), R_b=(R_b, 2), axis=(axis, 1))
    q = kernels.quaternion_from_matrix(np.swapaxes(R_a, -1, -2) @ R_b)
    half = _turn((q[..., 1:] * axis).sum(axis=-1), q[..., 0])
    turn = 2 * half
    return np.where(turn <= -np.pi, np.pi, turn)[()]


def from_axis_angle(axis: ArrayLike, angle: ArrayLike) -> np.ndarray:
    """Return the rotation (..., 3, 3) about an axis by an angle: ``exp(angle axis)``.

    Parameters
    ----------
    axis : (..., 3) axis of any non-zero length; only the direction matters.
    angle : (...) [rad], leading axes broadcast.

    Raises
    ------
    ShapeError : the axis has length 0, or leading axes do not broadcast.
    """
    axis, angle = _direction(axis), arguments.array(angle, (), "angle")
    arguments.broadcasts(axis=(axis, 1), angle=(angle, 0))
    return kernels.so3_exp(axis * angle[..., None])


def to_axis_angle(R: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Return the axis and angle of a rotation; the axis of the identity is (0, 0, 1).

    At a half turn, the first non-zero component of the axis is positive.

    Parameters
    ----------
    R : (..., 3, 3) rotation.

    Returns
    -------
    axis : (..., 3) unit vector.
    angle : (...) in [0, π] [rad].

    Raises
    ------
    ShapeError : R is not a rotation within `ROTATION_TOLERANCE`.
    """
    w = kernels.so3_log(R)
    length = _length(w)
    still = length == 0
    axis = np.where(still[..., None], (0.0, 0.0, 1.0), w / np.where(still, 1.0, length)[..., None])
    return axis, length


def _direction(axis: ArrayLike) -> np.ndarray:
    """Return the axis (..., 3) normalised to length 1."""
    axis = arguments.array(axis, (3,), "axis")
    length = _length(axis)
    bad = (length == 0) | (length == np.inf)
    if bad.any():
        raise ShapeError(f"Expected an axis of finite, non-zero length, got {axis[bad][0]}. Drop these samples.")
    return axis / length[..., None]


def _length(v: np.ndarray) -> np.ndarray:
    return np.hypot(np.hypot(v[..., 0], v[..., 1]), v[..., 2])


def _turn(sine: np.ndarray, cosine: np.ndarray) -> np.ndarray:
    """Return atan2 (...), or NaN if both arguments are zero up to rounding errors."""
    return np.where(np.hypot(sine, cosine) < UNDEFINED, np.nan, np.arctan2(sine, cosine))[()]


def mean(
    R: ArrayLike, weights: ArrayLike | None = None, method: Literal["chordal", "geodesic"] = "chordal"
) -> np.ndarray:
    """Return the mean (..., 3, 3) of rotations along axis 0; NaN if a rotation with non-zero weight is missing.

    The chordal mean minimises ``Σ weight norm(mean - R)²`` (Frobenius norm): it is the rotation nearest to the mean
    matrix. The geodesic mean minimises ``Σ weight angle(mean, R)²`` and is found by Newton steps from the chordal mean.
    The two means are equal for rotations distributed symmetrically about the mean, and nearly equal for a narrow
    spread.

    Parameters
    ----------
    R : (N, ..., 3, 3) rotations, N ≥ 1.
    weights : (N,) or (N, ...), non-negative; default: equal. A weight of 0 excludes a rotation, even a missing one.
    method : "chordal" or "geodesic".

    Raises
    ------
    ShapeError : an argument is not a rotation, the weights are invalid, or the mean is undefined: ``σ₂ + d σ₃ < 0.1``
        with the singular values ``σ`` of the mean matrix and the sign d of its determinant.
    NotConverged : the geodesic mean is not unique (rotations are approximately half a turn apart).
    UnknownName : unknown method.

    Reference: R. Hartley, J. Trumpf, Y. Dai, H. Li, Rotation averaging, Int. J. Computer Vision 103, 2013.
    """
    check_name(method, "mean of rotations", METHODS)
    R = kernels.rotations(R, "R")
    share = shares(weights, R.shape[:-2])
    R = np.where(share[..., None, None] > 0, R, np.eye(3))
    start, sigma = nearest((share[..., None, None] * R).sum(axis=0))
    agreement = sigma[..., 1] + sigma[..., 2]
    if (agreement < AGREEMENT).any():
        raise ShapeError(
            f"Expected rotations with a well-defined mean, got an agreement of {agreement.min():.2g}, below "
            f"{AGREEMENT:g}. Cluster them first."
        )
    return start if method == "chordal" else _geodesic(R, share, start)


def shares(weights: ArrayLike | None, batch: tuple[int, ...]) -> np.ndarray:
    """Return weights (N, ...), normalised along axis 0, for a batch with the given leading axes."""
    if not batch or batch[0] == 0:
        raise ShapeError(f"Expected at least one element along axis 0 for a mean, got leading axes {batch}.")
    if weights is None:
        return np.full((batch[0], *[1] * (len(batch) - 1)), 1 / batch[0])
    weights = arguments.array(weights, (), "weights")
    if weights.shape not in (batch[:1], batch):
        shapes = " or ".join(map(str, dict.fromkeys((batch[:1], batch))))
        raise ShapeError(f"Expected weights of shape {shapes}, got {weights.shape}.")
    weights = weights.reshape(weights.shape + (1,) * (len(batch) - weights.ndim))
    total = weights.sum(axis=0)
    if (weights < 0).any() or not ((total > 0) & (total < np.inf)).all():
        raise ShapeError(
            "Expected finite weights >= 0 with a positive sum, got a negative or non-finite weight, or only zeros. "
            "Use 0 to exclude an element."
        )
    return weights / total


def _geodesic(R: np.ndarray, share: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Refine a mean by Newton's method; the Hessian of angle²/2 is the symmetric part of the inverse left Jacobian."""
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
        f"Expected rotations with a unique geodesic mean, but the iteration did not converge in {ITERATIONS} steps. "
        "Use the chordal mean, or cluster the rotations first."
    )
