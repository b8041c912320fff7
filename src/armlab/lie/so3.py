"""Rotations SO(3) as arrays (..., 3, 3) and rotation vectors w (..., 3) [rad].

Every function takes any leading axes and keeps them. NaN gives NaN.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from armlab.errors import ShapeError
from armlab.lie import _check, quaternion

__all__ = [
    "ROTATION_TOLERANCE",
    "angle",
    "exp",
    "hat",
    "is_rotation",
    "left_jacobian",
    "left_jacobian_inv",
    "log",
    "project",
    "skew_part",
    "vee",
]

ROTATION_TOLERANCE = _check.ROTATION_TOLERANCE
"""Largest entry of |RᵀR - I| that passes for a rotation; beyond it, `project` first."""

SKEW_TOLERANCE = 1e-9
SERIES_BELOW = 0.5  # rad: above, the closed forms below keep all digits; here eight terms reach 1e-18
# (x - sin x) / x^3 and (1 - x/2 cot(x/2)) / x^2 in powers of x^2: (-1)^k / (2k + 3)! and |B_2k| / (2k)!
SINE_SERIES = tuple((-1) ** k / math.factorial(2 * k + 3) for k in range(8))
BERNOULLI = (1 / 6, 1 / 30, 1 / 42, 1 / 30, 5 / 66, 691 / 2730, 7 / 6, 3617 / 510)
COTANGENT_SERIES = tuple(b / math.factorial(2 * k) for k, b in enumerate(BERNOULLI, start=1))


def hat(w: ArrayLike) -> np.ndarray:
    """Return the skew matrix of a vector: ``hat(w) x = w × x``.

    Parameters
    ----------
    w : (..., 3).

    Returns
    -------
    (..., 3, 3).
    """
    w = _check.array(w, (3,), "w")
    W = np.zeros((*w.shape, 3))
    W[..., 2, 1], W[..., 0, 2], W[..., 1, 0] = x, y, z = np.moveaxis(w, -1, 0)
    W[..., 1, 2], W[..., 2, 0], W[..., 0, 1] = -x, -y, -z
    return W


def vee(W: ArrayLike) -> np.ndarray:
    """Return the vector of a skew matrix: ``vee(hat(w)) = w``.

    Parameters
    ----------
    W : (..., 3, 3), skew to 1e-9 of its largest entry.

    Returns
    -------
    (..., 3).

    Raises
    ------
    ShapeError : when W is not skew: `vee` is for so(3); for a rotation use `log`.
    """
    W = _check.array(W, (3, 3), "W")
    off = np.abs(W + np.swapaxes(W, -1, -2)).max(axis=(-1, -2))
    if (off > SKEW_TOLERANCE * np.abs(W).max(axis=(-1, -2))).any():
        raise ShapeError(
            f"Expected a skew matrix (W = -W^T), got max|W + W^T| = {np.nanmax(off):.3g}. "
            "Use log for a rotation, skew_part for a matrix that is nearly skew."
        )
    return np.stack([W[..., 2, 1], W[..., 0, 2], W[..., 1, 0]], axis=-1)


def skew_part(M: ArrayLike) -> np.ndarray:
    """Return the skew part of a matrix: ``(M - Mᵀ) / 2``.

    Parameters
    ----------
    M : (..., 3, 3).

    Returns
    -------
    (..., 3, 3).
    """
    M = _check.array(M, (3, 3), "M")
    return (M - np.swapaxes(M, -1, -2)) / 2


def exp(w: ArrayLike) -> np.ndarray:
    """Return the rotation about w by abs(w): ``I + sin θ/θ hat(w) + 2 sin²(θ/2)/θ² hat(w)²``, θ = abs(w).

    Parameters
    ----------
    w : (..., 3) rotation vector [rad].

    Returns
    -------
    (..., 3, 3).
    """
    w = _check.array(w, (3,), "w")
    theta = _norm(w)
    return _polynomial(w, _sinc(theta), _sinc(theta / 2) ** 2 / 2)


def log(R: ArrayLike) -> np.ndarray:
    """Return the rotation vector of least length: ``exp(log(R)) = R``, abs(log(R)) ≤ π.

    It goes through the quaternion (w, v): ``2 atan2(abs(v), w) v/abs(v)``, which keeps all digits from 1e-300 rad to
    a half turn. At a half turn the first component that is not zero is positive.

    Parameters
    ----------
    R : (..., 3, 3).

    Returns
    -------
    (..., 3) [rad].

    Raises
    ------
    ShapeError : when R is not a rotation within `ROTATION_TOLERANCE`.
    """
    q = quaternion.from_matrix(R)
    length = _norm(q[..., 1:])
    theta = 2 * np.arctan2(length, q[..., 0])
    return q[..., 1:] * _ratio(theta, length, 2.0)[..., None]


def angle(R_a: ArrayLike, R_b: ArrayLike) -> np.ndarray:
    """Return the angle between two rotations: ``abs(log(R_aᵀ R_b))``.

    Parameters
    ----------
    R_a, R_b : (..., 3, 3), leading axes broadcast.

    Returns
    -------
    (...) in [0, π] [rad].

    Raises
    ------
    ShapeError : when one is not a rotation within `ROTATION_TOLERANCE`.
    """
    R_a, R_b = _check.rotation(R_a, "R_a"), _check.rotation(R_b, "R_b")
    q = quaternion.from_matrix(np.swapaxes(R_a, -1, -2) @ R_b)
    return 2 * np.arctan2(_norm(q[..., 1:]), q[..., 0])


def is_rotation(R: ArrayLike, tolerance: float = ROTATION_TOLERANCE) -> np.ndarray:
    """Tell which matrices are rotations: ``RᵀR = I`` and ``det R > 0``.

    Parameters
    ----------
    R : (..., 3, 3).
    tolerance : largest entry of ``abs(RᵀR - I)`` that passes.

    Returns
    -------
    (...) bool; False for NaN and infinity.
    """
    R = _check.array(R, (3, 3), "R")
    R = np.where(np.isfinite(R).all(axis=(-1, -2), keepdims=True), R, 0.0)
    return (_check.orthonormality(R) <= tolerance) & (_check.determinant(R) > 0)


def project(M: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Return the rotation nearest to a matrix and how far it is: ``U diag(1, 1, det UVᵀ) Vᵀ`` of ``M = U S Vᵀ``.

    Parameters
    ----------
    M : (..., 3, 3).

    Returns
    -------
    R : (..., 3, 3) the minimiser of the Frobenius norm of ``R - M``.
    distance : (...) that norm.

    Raises
    ------
    ShapeError : when no rotation is nearest (rank below 2 or a reflection of equal axes).
    """
    M = _check.array(M, (3, 3), "M")
    missing = ~np.isfinite(M).all(axis=(-1, -2), keepdims=True)
    U, S, Vt = np.linalg.svd(np.where(missing, np.eye(3), M))
    sign = _check.determinant(U @ Vt)
    ambiguous = S[..., 1] + sign * S[..., 2] <= 1e-9 * S[..., 0]
    if ambiguous.any():
        raise ShapeError(f"Expected matrices with one nearest rotation, got singular values {S[ambiguous][0]}.")
    U[..., 2] *= np.sign(sign)[..., None]
    R = np.where(missing, np.nan, U @ Vt)
    return R, np.linalg.norm(R - M, axis=(-1, -2))


def left_jacobian(w: ArrayLike) -> np.ndarray:
    """Return J with ``exp(w + dw) = exp(J dw) exp(w)``: ``I + (1 - cos θ)/θ² hat(w) + (θ - sin θ)/θ³ hat(w)²``.

    Parameters
    ----------
    w : (..., 3) rotation vector [rad].

    Returns
    -------
    (..., 3, 3).
    """
    w = _check.array(w, (3,), "w")
    theta = _norm(w)
    small = theta < SERIES_BELOW
    x = np.where(small, 1.0, theta)
    cubic = np.where(small, _series(SINE_SERIES, theta), (x - np.sin(x)) / x**3)
    return _polynomial(w, _sinc(theta / 2) ** 2 / 2, cubic)


def left_jacobian_inv(w: ArrayLike) -> np.ndarray:
    """Return the inverse of `left_jacobian`: ``I - hat(w)/2 + (1 - θ/2 cot(θ/2))/θ² hat(w)²``.

    Parameters
    ----------
    w : (..., 3) rotation vector shorter than 2π [rad].

    Returns
    -------
    (..., 3, 3).
    """
    w = _check.array(w, (3,), "w")
    theta = _norm(w)
    small = theta < SERIES_BELOW
    x = np.where(small, 1.0, theta)
    square = np.where(small, _series(COTANGENT_SERIES, theta), (1 - x / 2 * np.cos(x / 2) / np.sin(x / 2)) / x**2)
    return _polynomial(w, np.full_like(theta, -0.5), square)


def _polynomial(w: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return ``I + a hat(w) + b hat(w)²``."""
    W = hat(w)
    return np.eye(3) + a[..., None, None] * W + b[..., None, None] * (W @ W)


def _norm(v: np.ndarray) -> np.ndarray:
    """Length that neither underflows at 1e-300 nor overflows."""
    return np.hypot(np.hypot(v[..., 0], v[..., 1]), v[..., 2])


def _ratio(x: np.ndarray, y: np.ndarray, at_zero: float) -> np.ndarray:
    """Return x / y, and its limit where y is 0."""
    zero = y == 0
    return np.where(zero, at_zero, x / np.where(zero, 1.0, y))


def _sinc(x: np.ndarray) -> np.ndarray:
    """Return sin(x) / x."""
    return _ratio(np.sin(x), x, 1.0)


def _series(coefficients: tuple[float, ...], theta: np.ndarray) -> np.ndarray:
    """Return the power series in θ², used below `SERIES_BELOW`."""
    x = np.minimum(theta, SERIES_BELOW) ** 2
    total = np.zeros_like(x)
    for coefficient in reversed(coefficients):
        total = total * x + coefficient
    return total
