"""Arguments of the Lie groups: the checks of `native/lie_arguments.cpp`, with the same sentences.

NaN passes: what is missing stays missing.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from armlab.errors import ShapeError
from armlab.kernels._reference.arrays import elements

__all__ = ["broadcast", "departure", "poses", "rotations", "unit"]

ROTATION_TOLERANCE = 1e-6
UNIT_TOLERANCE = 1e-3


def departure(R: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return how far matrices (..., 3, 3) are from rotations: the largest entry of ``abs(RᵀR - I)``, and det R."""
    off = np.abs(np.swapaxes(R, -1, -2) @ R - np.eye(3)).max(axis=(-1, -2))
    return off, np.vecdot(np.cross(R[..., 0], R[..., 1]), R[..., 2])


def rotations(R: Any, name: str) -> np.ndarray:
    """Return rotations (..., 3, 3) as float64, refusing the first that is off by more than 1e-6.

    Parameters
    ----------
    R : (..., 3, 3).
    name : how error messages call it.

    Raises
    ------
    ShapeError
        When the shape is another, ``max|RᵀR - I| > 1e-6``, the determinant is negative, or an entry is infinite.
    """
    R = elements(R, name, (3, 3))
    largest = np.abs(R).max(axis=(-1, -2))
    finite = np.where((largest < np.inf)[..., None, None], R, 0.0)
    off, det = departure(finite)
    present = ~np.isnan(largest)
    bad = present & ((largest == np.inf) | (off > ROTATION_TOLERANCE) | (det < 0))
    if not bad.any():
        return R
    first = _first(bad)
    if largest[first] == np.inf:
        came = "max|R| = inf"
    elif off[first] > ROTATION_TOLERANCE:
        came = f"max|R^T R - I| = {off[first]:.3g}"
    else:
        came = f"determinant = {det[first]:.3g}"
    raise ShapeError(
        f"Expected {_indexed(name, first)} to be a rotation within {ROTATION_TOLERANCE:g}, got {came}. "
        "Project it first if that is what you want (lie.so3.project, lie.se3.project)."
    )


def poses(T: Any, name: str) -> np.ndarray:
    """Return poses (..., 4, 4) as float64, refusing the first that is none.

    Parameters
    ----------
    T : (..., 4, 4).
    name : how error messages call it.

    Raises
    ------
    ShapeError
        When the shape is another, the rotation is none, or the last row is not (0, 0, 0, 1).
    """
    T = elements(T, name, (4, 4))
    rotations(T[..., :3, :3], f"the rotation of {name}")
    off = np.abs(T[..., 3, :] - (0.0, 0.0, 0.0, 1.0)).max(axis=-1)
    bad = (off > 0) | (np.isnan(off) & ~np.isnan(T[..., :3, :3]).any(axis=(-1, -2)))  # a NaN here alone would vanish
    if bad.any():
        first = _first(bad)
        raise ShapeError(
            f"Expected (0, 0, 0, 1) as the last row of {_indexed(name, first)}, got one off by {off[first]:.3g}."
        )
    return T


def unit(q: Any, name: str) -> np.ndarray:
    """Return quaternions (..., 4) divided by their length, refusing the first that is off 1 by more than 1e-3.

    Parameters
    ----------
    q : (..., 4) wxyz.
    name : how error messages call it.

    Raises
    ------
    ShapeError
        When the shape or a length is another.
    """
    q = elements(q, name, (4,))
    length = np.linalg.norm(q, axis=-1)
    bad = np.abs(length - 1) > UNIT_TOLERANCE
    if bad.any():
        first = _first(bad)
        raise ShapeError(
            f"Expected {_indexed(name, first)} of length 1 within {UNIT_TOLERANCE:g} (wxyz), "
            f"got length {length[first]:.6g}."
        )
    return q / length[..., None]


def broadcast(**arguments: tuple[np.ndarray, int]) -> list[np.ndarray]:
    """Return arrays with the same leading axes, by the rules of NumPy.

    Parameters
    ----------
    **arguments : by name, an array and the number of its last axes that are no leading axes.

    Raises
    ------
    ShapeError
        When NumPy's rules do not allow it.
    """
    try:
        batch = np.broadcast_shapes(*(array.shape[: array.ndim - tail] for array, tail in arguments.values()))
    except ValueError:
        came = ", ".join(f"{name} of shape {array.shape}" for name, (array, _) in arguments.items())
        raise ShapeError(f"Expected leading axes that broadcast, got {came}.") from None
    return [np.broadcast_to(array, batch + array.shape[array.ndim - tail :]) for array, tail in arguments.values()]


def _first(bad: np.ndarray) -> tuple[int, ...]:
    return tuple(int(i) for i in np.argwhere(bad)[0])


def _indexed(name: str, index: tuple[int, ...]) -> str:
    return f"{name}[{', '.join(map(str, index))}]" if index else name
