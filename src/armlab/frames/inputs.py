"""Argument checks for frames: points, vectors and poses."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import number, numbers, positive, rows_text, still
from armlab.errors import NotExcited, ShapeError
from armlab.lie import se3

UNIT = 1e-9  # deviation of a norm from 1 that is accepted as rounding error


def points(p: ArrayLike, what: str = "points") -> np.ndarray:
    """Return points (N, 3); raise an error for other shapes and non-finite rows."""
    array = numbers(p, what, ShapeError)
    if array.ndim != 2 or array.shape[1] != 3:
        hint = " Transpose them." if array.ndim == 2 and array.shape[0] == 3 else ""
        raise ShapeError(f"Expected {what} of shape (N, 3) [m], got {array.shape}.{hint}")
    bad = np.flatnonzero(~np.isfinite(array).all(axis=1))
    if len(bad):
        raise ShapeError(f"Expected finite {what}, got NaN or Inf in rows {rows_text(bad)}. Drop these rows.")
    return array


def sightings(p: ArrayLike, visible: ArrayLike | None, what: str) -> tuple[np.ndarray, np.ndarray]:
    """Return K points in N frames (N, K, 3) and their visibility (N, K); raise an error for NaN in visible points."""
    array = numbers(p, what, ShapeError)
    if array.ndim != 3 or array.shape[2] != 3 or not array.shape[1]:
        raise ShapeError(f"Expected {what} of shape (N, K, 3), got {array.shape}. Pass K points for every frame.")
    seen = np.ones(array.shape[:2], dtype=bool) if visible is None else np.asarray(visible)
    if seen.shape != array.shape[:2] or seen.dtype != bool:
        raise ShapeError(
            f"Expected visible to be booleans of shape {array.shape[:2]}, got {seen.dtype} of shape {seen.shape}. "
            "Pass one value per point and frame."
        )
    bad = np.flatnonzero((seen & ~np.isfinite(array).all(axis=2)).any(axis=1))
    if len(bad):
        raise ShapeError(
            f"Expected finite {what} where points are visible, got NaN or Inf in {len(bad)} rows: {rows_text(bad)}. "
            f"Mark missing points: visible=np.isfinite({what}).all(axis=2)."
        )
    return array, seen


def marker_points(marker: ArrayLike, K: int, what: str) -> np.ndarray:
    """Return the points (K, 3) of a marker with K measured points."""
    array = numbers(marker, "marker", ShapeError)
    if array.shape != (K, 3) or not np.isfinite(array).all():
        raise ShapeError(
            f"Expected the marker to be ({K}, 3) finite numbers, because {what} has {K} points, got {array.shape}. "
            "Pass the points in the order of the recording."
        )
    return array


def check_count(count: int, needed: int, what: str) -> None:
    if count < needed:
        raise NotExcited(
            f"Expected at least {needed} points to fit a {what} and its noise, got {count}. Measure more points, or "
            "pass noise= if it is known.",
            ["everything"],
            [f"{count} points"],
        )


def noise_of(noise: Any) -> float | None:
    """Return the standard deviation of each coordinate [m], or None if the noise must be estimated."""
    return None if noise is None else positive(noise, "noise [m]", "Omit noise to estimate it.")


def noises_of(noise: Any, count: int) -> tuple[float | None, np.ndarray | None]:
    """Return the SD of a coordinate [m], and covariances (N, 3, 3) if directions or points have unequal noise."""
    if noise is None or np.ndim(noise) == 0:
        return noise_of(noise), None
    C = numbers(noise, "noise", ShapeError)
    if C.shape not in ((3, 3), (count, 3, 3)) or not np.isfinite(C).all():
        raise ShapeError(
            f"Expected noise to be a standard deviation [m] or a covariance (3, 3) or ({count}, 3, 3) [m^2], got shape "
            f"{C.shape}."
        )
    each = np.broadcast_to(C, (count, 3, 3))
    skew = np.abs(each - np.swapaxes(each, 1, 2)).max(axis=(1, 2)) > 1e-9 * np.abs(each).max(axis=(1, 2))
    bad = np.flatnonzero(skew | (np.linalg.eigvalsh(each)[:, 0] <= 0))
    if len(bad):
        raise ShapeError(
            "Expected noise with symmetric, positive definite covariances, got an invalid covariance at point "
            f"{bad[0]}. The diagonal must contain squared standard deviations."
        )
    return float(np.sqrt(np.trace(each, axis1=1, axis2=2).mean() / 3.0)), each


def limit_of(limit: Any) -> float:
    value = number(limit, "limit [rad]")
    if not value > 0.0:
        raise ShapeError(f"Expected limit to be a standard deviation > 0 rad, got {value:g}. The default is 0.2.")
    return value


def vector(v: ArrayLike, what: str) -> np.ndarray:
    array = still(v, what)
    if array.shape != (3,) or not np.isfinite(array).all():
        raise ShapeError(f"Expected {what} to be a finite vector (3,), got {array.tolist()}.")
    return array


def direction(v: ArrayLike, what: str) -> np.ndarray:
    array = vector(v, what)
    length = float(np.linalg.norm(array))
    if not length > 0.0:
        raise ShapeError(f"Expected {what} to have a non-zero length, got a vector of length zero.")
    return array / length


def unit(v: ArrayLike, what: str) -> np.ndarray:
    array = vector(v, what)
    off = abs(float(np.linalg.norm(array)) - 1.0)
    if off > UNIT:
        raise ShapeError(
            f"Expected {what} to have length 1, got a length error of {off:.2g}. Use of() for a vector of any length."
        )
    return array


def pose(T: ArrayLike, what: str) -> np.ndarray:
    array = numbers(T, what, ShapeError)
    if array.shape == (4, 4):
        array = se3.orthonormalise(array)
    if array.shape != (4, 4) or not se3.is_pose(array):
        raise ShapeError(
            f"Expected {what} to be a pose (4, 4), got shape {array.shape} or a matrix that is not a pose. Apply "
            "lie.se3.project to a rounded rotation."
        )
    return array


def covariance(cov: ArrayLike | None, size: int, what: str) -> np.ndarray | None:
    """Return a symmetric, positive semidefinite covariance (size, size) as a read-only copy, or None."""
    if cov is None:
        return None
    C = still(cov, what)
    fits = C.shape == (size, size) and np.isfinite(C).all() and np.allclose(C, C.T, rtol=1e-9, atol=0.0)
    if not fits or np.linalg.eigvalsh(C)[0] < -1e-9 * np.trace(C):
        raise ShapeError(
            f"Expected {what} to be a symmetric positive semidefinite covariance ({size}, {size}), got {C.shape}. The "
            "diagonal must contain squared standard deviations."
        )
    return C


def across(v: np.ndarray) -> np.ndarray:
    """Return two unit vectors (2, 3) that form a right-handed frame with v (3,) as the third axis."""
    e = np.eye(3)[np.argmin(np.abs(v))]
    first = np.cross(e, v)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(v, first)])


def turned(R: np.ndarray, third: np.ndarray, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotate a unit direction (3,) and the axes normal to it (2, 3), and orthonormalise them."""
    v = R @ third
    v = v / np.linalg.norm(v)
    first = R @ axes[0]
    first = first - v * (v @ first)
    first = first / np.linalg.norm(first)
    second = np.cross(v, first)
    return v, np.stack([first, second if second @ (R @ axes[1]) > 0 else -second])
