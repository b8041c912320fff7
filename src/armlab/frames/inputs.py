"""Points, vectors and poses as the functions of frames take them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import number, numbers, rows_text
from armlab.errors import NotExcited, ShapeError
from armlab.lie import se3

UNIT = 1e-9  # deviation of a length from 1 that is rounding


def points(p: ArrayLike, what: str = "points") -> np.ndarray:
    """Return points (N, 3), refusing other shapes and rows that are not finite."""
    array = numbers(p, what, ShapeError)
    if array.ndim != 2 or array.shape[1] != 3:
        hint = " Transpose them." if array.ndim == 2 and array.shape[0] == 3 else ""
        raise ShapeError(f"Expected {what} of shape (N, 3) [m], got {array.shape}.{hint}")
    bad = np.flatnonzero(~np.isfinite(array).all(axis=1))
    if len(bad):
        raise ShapeError(f"Expected finite {what}, got NaN or Inf in rows {rows_text(bad)}. Drop these rows.")
    return array


def sightings(p: ArrayLike, visible: ArrayLike | None, what: str) -> tuple[np.ndarray, np.ndarray]:
    """Return points (N, K, 3) seen in N frames and which are visible (N, K), refusing NaN where they are."""
    array = numbers(p, what, ShapeError)
    if array.ndim != 3 or array.shape[2] != 3 or not array.shape[1]:
        raise ShapeError(f"Expected {what} of shape (N, K, 3), got {array.shape}. Give every point in every frame.")
    seen = np.ones(array.shape[:2], dtype=bool) if visible is None else np.asarray(visible)
    if seen.shape != array.shape[:2] or seen.dtype != bool:
        raise ShapeError(
            f"Expected visible as truth values of shape {array.shape[:2]}, got {seen.dtype} of shape {seen.shape}. "
            "Say of every point in every frame whether it was seen."
        )
    bad = np.flatnonzero((seen & ~np.isfinite(array).all(axis=2)).any(axis=1))
    if len(bad):
        raise ShapeError(
            f"Expected finite {what} where points are visible, got NaN or Inf in {len(bad)} rows: {rows_text(bad)}. "
            f"Say which points are missing: visible=np.isfinite({what}).all(axis=2)."
        )
    return array, seen


def marker_points(marker: ArrayLike, K: int, what: str) -> np.ndarray:
    """Return the points (K, 3) of a marker of which K points were seen."""
    array = numbers(marker, "marker", ShapeError)
    if array.shape != (K, 3) or not np.isfinite(array).all():
        raise ShapeError(
            f"Expected the marker as ({K}, 3) finite numbers, as {what} has {K} points, got {array.shape}. "
            "Give the points in the order of the records."
        )
    return array


def enough(count: int, needed: int, what: str) -> None:
    if count < needed:
        raise NotExcited(
            f"Expected at least {needed} points to fit a {what} and its noise, got {count}. Measure more points, or "
            "give noise= where it is known.",
            ["everything"],
            [f"{count} points"],
        )


def noise_of(noise: Any) -> float | None:
    """Return the deviation of one coordinate [m], or None where it is to be estimated."""
    if noise is None:
        return None
    sigma = number(noise, "noise [m]")
    if not 0.0 < sigma < np.inf:
        raise ShapeError(
            f"Expected noise to be a deviation above zero [m], got {sigma:g}. Leave it out to estimate it."
        )
    return sigma


def noises_of(noise: Any, count: int) -> tuple[float | None, np.ndarray | None]:
    """Return the deviation of a coordinate [m] and, where directions or points differ, covariances (N, 3, 3)."""
    if noise is None or np.ndim(noise) == 0:
        return noise_of(noise), None
    C = numbers(noise, "noise", ShapeError)
    if C.shape not in ((3, 3), (count, 3, 3)) or not np.isfinite(C).all():
        raise ShapeError(
            f"Expected noise as a deviation [m] or a covariance (3, 3) or ({count}, 3, 3) [m^2], got shape {C.shape}."
        )
    each = np.broadcast_to(C, (count, 3, 3))
    skew = np.abs(each - np.swapaxes(each, 1, 2)).max(axis=(1, 2)) > 1e-9 * np.abs(each).max(axis=(1, 2))
    bad = np.flatnonzero(skew | (np.linalg.eigvalsh(each)[:, 0] <= 0))
    if len(bad):
        raise ShapeError(
            f"Expected noise with symmetric, positive definite covariances, got another one at point {bad[0]}. "
            "Deviations go squared on the diagonal."
        )
    return float(np.sqrt(np.trace(each, axis1=1, axis2=2).mean() / 3.0)), each


def limit_of(limit: Any) -> float:
    value = number(limit, "limit [rad]")
    if not value > 0.0:
        raise ShapeError(f"Expected limit to be a deviation above zero [rad], got {value:g}. 0.2 is the usual one.")
    return value


def vector(v: ArrayLike, what: str) -> np.ndarray:
    array = np.array(numbers(v, what, ShapeError))
    if array.shape != (3,) or not np.isfinite(array).all():
        raise ShapeError(f"Expected {what} to be a finite vector (3,), got {array.tolist()}.")
    array.flags.writeable = False
    return array


def direction(v: ArrayLike, what: str) -> np.ndarray:
    array = vector(v, what)
    length = float(np.linalg.norm(array))
    if not length > 0.0:
        raise ShapeError(f"Expected {what} to have a direction, got a vector of length zero.")
    return array / length


def unit(v: ArrayLike, what: str) -> np.ndarray:
    array = vector(v, what)
    off = abs(float(np.linalg.norm(array)) - 1.0)
    if off > UNIT:
        raise ShapeError(
            f"Expected {what} to have length 1, got one off by {off:.2g}. Make it from any vector by of()."
        )
    return array


def pose(T: ArrayLike, what: str) -> np.ndarray:
    array = numbers(T, what, ShapeError)
    if array.shape != (4, 4) or not se3.is_pose(array):
        raise ShapeError(
            f"Expected {what} to be a pose (4, 4), got shape {array.shape} or a matrix that is none. "
            "Project it first if its rotation is nearly one (lie.se3.project)."
        )
    return array


def covariance(cov: ArrayLike | None, size: int, what: str) -> np.ndarray | None:
    """Return a symmetric covariance (size, size) that is not negative as a read-only copy, or None."""
    if cov is None:
        return None
    C = np.array(numbers(cov, what, ShapeError))
    fits = C.shape == (size, size) and np.isfinite(C).all() and np.allclose(C, C.T, rtol=1e-9, atol=0.0)
    if not fits or np.linalg.eigvalsh(C)[0] < -1e-9 * np.trace(C):
        raise ShapeError(
            f"Expected {what} to be a symmetric covariance ({size}, {size}) that is not negative, got shape {C.shape}. "
            "Deviations go squared on its diagonal."
        )
    C.flags.writeable = False
    return C


def across(v: np.ndarray) -> np.ndarray:
    """Return two unit vectors (2, 3) that make a right-handed frame with v (3,) as the third."""
    e = np.eye(3)[np.argmin(np.abs(v))]
    first = np.cross(e, v)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(v, first)])


def turned(R: np.ndarray, third: np.ndarray, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a unit direction (3,) and the axes (2, 3) across it, turned; rounding does not add up over many turns."""
    v = R @ third
    v = v / np.linalg.norm(v)
    first = R @ axes[0]
    first = first - v * (v @ first)
    first = first / np.linalg.norm(first)
    second = np.cross(v, first)
    return v, np.stack([first, second if second @ (R @ axes[1]) > 0 else -second])
