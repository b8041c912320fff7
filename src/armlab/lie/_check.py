"""Arguments of the group functions: shapes and membership, refused with a sentence.

NaN passes: what is missing stays missing.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from armlab.errors import ShapeError

ROTATION_TOLERANCE = 1e-6


def array(value: ArrayLike, tail: tuple[int, ...], name: str) -> np.ndarray:
    """Return `value` as float64, refusing a shape that does not end with `tail`."""
    wanted = f"(..., {', '.join(map(str, tail))})"
    try:
        result = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise ShapeError(f"Expected numbers of shape {wanted} for {name}, got {type(value).__name__}.") from None
    if result.shape[-len(tail) :] != tail:
        raise ShapeError(f"Expected {name} of shape {wanted}, got {result.shape}.")
    return result


def rotation(R: ArrayLike, name: str = "R") -> np.ndarray:
    """Return rotations (..., 3, 3), refusing matrices that are none."""
    R = array(R, (3, 3), name)
    largest = np.abs(R).max(axis=(-1, -2))
    refuse(name, largest == np.inf, largest, "max|R|")
    off, det = orthonormality(R), determinant(R)
    refuse(name, off > ROTATION_TOLERANCE, off, "max|R^T R - I|")
    refuse(name, det < 0, det, "determinant")
    return R


def pose(T: ArrayLike, name: str = "T") -> np.ndarray:
    """Return poses (..., 4, 4), refusing matrices that are none."""
    T = array(T, (4, 4), name)
    rotation(T[..., :3, :3], f"the rotation of {name}")
    last_row(T, name)
    return T


def last_row(T: np.ndarray, name: str) -> None:
    """Refuse a last row other than (0, 0, 0, 1)."""
    off = np.abs(T[..., 3, :] - (0.0, 0.0, 0.0, 1.0)).max(axis=-1)
    bad = (off > 0) | (np.isnan(off) & ~np.isnan(T[..., :3, :]).any(axis=(-1, -2)))  # a NaN here alone would vanish
    if bad.any():
        raise ShapeError(f"Expected (0, 0, 0, 1) as the last row of {name}, got one off by {off[bad].max():.3g}.")


def orthonormality(R: np.ndarray) -> np.ndarray:
    """Return max|RᵀR - I|, (...); NaN for NaN."""
    return np.abs(np.swapaxes(R, -1, -2) @ R - np.eye(3)).max(axis=(-1, -2))


def determinant(R: np.ndarray) -> np.ndarray:
    """Return det R, (...); NaN for NaN, of which numpy.linalg.det would warn."""
    return (np.cross(R[..., 0, :], R[..., 1, :]) * R[..., 2, :]).sum(axis=-1)


def refuse(name: str, bad: np.ndarray, value: np.ndarray, measure: str) -> None:
    """Raise for the first bad matrix, with its index and what was measured."""
    if not bad.any():
        return
    index = tuple(int(i) for i in np.argwhere(bad)[0])
    where = f"{name}[{', '.join(map(str, index))}]" if index else name
    raise ShapeError(
        f"Expected {where} to be a rotation within {ROTATION_TOLERANCE:g}, got {measure} = {value[index]:.3g}. "
        "Project it first if that is what you want (lie.so3.project, lie.se3.project)."
    )
