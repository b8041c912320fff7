"""Vectors of libraries that put the angular part first."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from armlab.errors import ShapeError
from armlab.lie import _check


def from_angular_first(x: ArrayLike, axis: int = -1) -> np.ndarray:
    """Return [v; w] of a twist [w; v] of a library that puts the angular part first; [f; m] of a wrench [m; f].

    Parameters
    ----------
    x : array with length 6 along the axis: twists or wrenches (..., 6); a Jacobian (..., 6, n) with axis -2; a
        6 × 6 matrix needs it along both axes.
    axis : the axis to turn over.

    Returns
    -------
    the same shape.

    Raises
    ------
    ShapeError : when the axis has another length.
    """
    return _swap(x, axis)


def to_angular_first(x: ArrayLike, axis: int = -1) -> np.ndarray:
    """Return [w; v] of a twist [v; w] for a library that puts the angular part first; [m; f] of a wrench [f; m].

    Parameters
    ----------
    x : array with length 6 along the axis, as for `from_angular_first`, which it undoes.
    axis : the axis to turn over.

    Returns
    -------
    the same shape.

    Raises
    ------
    ShapeError : when the axis has another length.
    """
    return _swap(x, axis)


def _swap(x: ArrayLike, axis: int) -> np.ndarray:
    x = _check.array(x, (), "x")
    if not isinstance(axis, int | np.integer) or not -x.ndim <= axis < x.ndim or x.shape[axis] != 6:
        raise ShapeError(f"Expected an array of length 6 along axis {axis}, got shape {x.shape}. Choose the axis.")
    return np.roll(x, 3, axis=axis)
