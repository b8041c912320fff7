"""Rotations SO(3) as arrays (..., 3, 3) and rotation vectors w (..., 3) [rad].

Every function takes any leading axes and keeps them. NaN gives NaN.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from armlab import kernels
from armlab.errors import ShapeError
from armlab.lie import _check
from armlab.lie._angles import angle, angle_about, from_axis_angle, to_axis_angle, xy_angle
from armlab.lie._mean import mean

__all__ = [
    "ROTATION_TOLERANCE",
    "angle",
    "angle_about",
    "exp",
    "from_axis_angle",
    "hat",
    "interpolate",
    "is_rotation",
    "left_jacobian",
    "left_jacobian_inv",
    "log",
    "mean",
    "project",
    "skew_part",
    "to_axis_angle",
    "vee",
    "xy_angle",
]

ROTATION_TOLERANCE = _check.ROTATION_TOLERANCE
"""Largest entry of |RᵀR - I| that passes for a rotation; beyond it, `project` first."""

SKEW_TOLERANCE = 1e-9
ONE_NEAREST = 1e-9


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


def exp(w: ArrayLike, out: np.ndarray | None = None) -> np.ndarray:
    """Return the rotation about w by abs(w): ``I + sin θ/θ hat(w) + 2 sin²(θ/2)/θ² hat(w)²``, θ = abs(w).

    Parameters
    ----------
    w : (..., 3) rotation vector [rad].
    out : (..., 3, 3) array to write into.

    Returns
    -------
    (..., 3, 3).
    """
    return kernels.so3_exp(w, out)


def log(R: ArrayLike, out: np.ndarray | None = None) -> np.ndarray:
    """Return the rotation vector of least length: ``exp(log(R)) = R``, abs(log(R)) ≤ π.

    It goes through the quaternion (w, v): ``2 atan2(abs(v), w) v/abs(v)``, which keeps all digits from 1e-300 rad to
    a half turn. At a half turn the first component that is not zero is positive.

    Parameters
    ----------
    R : (..., 3, 3).
    out : (..., 3) array to write into.

    Returns
    -------
    (..., 3) [rad].

    Raises
    ------
    ShapeError : when R is not a rotation within `ROTATION_TOLERANCE`.
    """
    return kernels.so3_log(R, out)


def is_rotation(R: ArrayLike, tolerance: float = ROTATION_TOLERANCE) -> np.ndarray:
    """Tell which matrices are rotations: ``RᵀR = I`` and ``det R > 0``.

    Parameters
    ----------
    R : (..., 3, 3).
    tolerance : largest entry of ``abs(RᵀR - I)`` that passes.

    Returns
    -------
    (...) bool; False for NaN and infinity.

    Raises
    ------
    ShapeError : another shape, a tolerance that is no number from 0 on.
    """
    R, tolerance = _check.array(R, (3, 3), "R"), _check.tolerance(tolerance)
    R = np.where(np.isfinite(R).all(axis=(-1, -2), keepdims=True), R, 0.0)
    off = np.abs(np.swapaxes(R, -1, -2) @ R - np.eye(3)).max(axis=(-1, -2))
    determinant = (np.cross(R[..., 0, :], R[..., 1, :]) * R[..., 2, :]).sum(axis=-1)
    return (off <= tolerance) & (determinant > 0)


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
    ShapeError : when no rotation is nearest (rank below 2, a reflection of equal axes, an infinite entry).
    """
    M = _check.array(M, (3, 3), "M")
    R, sigma = kernels.so3_nearest(M)
    ambiguous = sigma[..., 1] + sigma[..., 2] <= ONE_NEAREST * sigma[..., 0]
    if ambiguous.any():
        raise ShapeError(
            f"Expected matrices with one nearest rotation, got singular values {abs(sigma[ambiguous][0])}."
        )
    if (np.isinf(M).any(axis=(-1, -2)) & ~np.isnan(M).any(axis=(-1, -2))).any():
        raise ShapeError("Expected matrices with one nearest rotation, got one with an infinite entry.")
    return R, np.linalg.norm(R - M, axis=(-1, -2))


def left_jacobian(w: ArrayLike, out: np.ndarray | None = None) -> np.ndarray:
    """Return J with ``exp(w + dw) = exp(J dw) exp(w)``: ``I + (1 - cos θ)/θ² hat(w) + (θ - sin θ)/θ³ hat(w)²``.

    Parameters
    ----------
    w : (..., 3) rotation vector [rad].
    out : (..., 3, 3) array to write into.

    Returns
    -------
    (..., 3, 3). The right Jacobian is ``left_jacobian(-w)``.
    """
    return kernels.so3_left_jacobian(w, out)


def left_jacobian_inv(w: ArrayLike, out: np.ndarray | None = None) -> np.ndarray:
    """Return the inverse of `left_jacobian`: ``I - hat(w)/2 + (1 - θ/2 cot(θ/2))/θ² hat(w)²``.

    Parameters
    ----------
    w : (..., 3) rotation vector shorter than 2π [rad].
    out : (..., 3, 3) array to write into.

    Returns
    -------
    (..., 3, 3).
    """
    return kernels.so3_left_jacobian_inv(w, out)


def interpolate(R_a: ArrayLike, R_b: ArrayLike, s: ArrayLike, out: np.ndarray | None = None) -> np.ndarray:
    """Turn from a to b about one axis at constant speed: ``R_a exp(s log(R_aᵀ R_b))``.

    Both ends are exact. Between them it is `quaternion.slerp`; beyond them the turn goes on.

    Parameters
    ----------
    R_a, R_b : (..., 3, 3), leading axes broadcast with those of s.
    s : (...) 0 at a, 1 at b.
    out : (..., 3, 3) array to write into.

    Returns
    -------
    (..., 3, 3).

    Raises
    ------
    ShapeError : when one is not a rotation within `ROTATION_TOLERANCE`.
    """
    return kernels.so3_interpolate(R_a, R_b, s, out)
