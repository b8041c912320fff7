"""Angles between rotations, turns about a given axis, axis and angle."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from armlab import kernels
from armlab.errors import ShapeError
from armlab.lie import _check

UNDEFINED = 1e-13  # below, a direction is lost in rounding


def angle(R_a: ArrayLike, R_b: ArrayLike) -> np.ndarray:
    """Return the angle between two rotations: ``abs(log(R_aᵀ R_b))``.

    Parameters
    ----------
    R_a, R_b : (..., 3, 3), leading axes broadcast.

    Returns
    -------
    (...) in [0, π] [rad]; 0 for equal ones.

    Raises
    ------
    ShapeError : when one is not a rotation within `ROTATION_TOLERANCE`.
    """
    return kernels.so3_angle(R_a, R_b)[()]


def xy_angle(R_a: ArrayLike, R_b: ArrayLike) -> np.ndarray:
    """Return the heading of b in a: the turn of b's x axis in a's xy plane, ``atan2(R_10, R_00)`` of ``R_aᵀ R_b``.

    Parameters
    ----------
    R_a, R_b : (..., 3, 3), leading axes broadcast.

    Returns
    -------
    (...) in (-π, π] [rad], positive about a's z axis; NaN where b's x axis is parallel to that.

    Raises
    ------
    ShapeError : when one is not a rotation within `ROTATION_TOLERANCE`.
    """
    R_a, R_b = kernels.rotations(R_a, "R_a"), kernels.rotations(R_b, "R_b")
    _check.broadcasts(R_a=(R_a, 2), R_b=(R_b, 2))
    x = (np.swapaxes(R_a, -1, -2) @ R_b[..., :1])[..., 0]
    return _turn(x[..., 1], x[..., 0])


def angle_about(R_a: ArrayLike, R_b: ArrayLike, axis: ArrayLike) -> np.ndarray:
    """Return the turn of b against a about an axis: the twist part ``2 atan2(axis · v, w)`` of ``R_aᵀ R_b``.

    What remains is a turn about an axis at right angles to it (swing-twist decomposition). For a pure turn about z
    it equals `xy_angle`.

    Parameters
    ----------
    R_a, R_b : (..., 3, 3), leading axes broadcast with those of the axis.
    axis : (..., 3) in a, of any length but 0.

    Returns
    -------
    (...) in (-π, π] [rad], positive about the axis; NaN where the rest is a half turn, which leaves it open.

    Raises
    ------
    ShapeError : when one is not a rotation within `ROTATION_TOLERANCE`, or the axis has length 0.
    """
    R_a, R_b, axis = kernels.rotations(R_a, "R_a"), kernels.rotations(R_b, "R_b"), _direction(axis)
    _check.broadcasts(R_a=(R_a, 2), R_b=(R_b, 2), axis=(axis, 1))
    q = kernels.quaternion_from_matrix(np.swapaxes(R_a, -1, -2) @ R_b)
    half = _turn((q[..., 1:] * axis).sum(axis=-1), q[..., 0])
    turn = 2 * half
    return np.where(turn <= -np.pi, np.pi, turn)[()]


def from_axis_angle(axis: ArrayLike, angle: ArrayLike) -> np.ndarray:
    """Return the rotation about an axis by an angle: ``exp(angle axis)``.

    Parameters
    ----------
    axis : (..., 3) of any length but 0; only its direction counts.
    angle : (...) [rad], leading axes broadcast.

    Returns
    -------
    (..., 3, 3).

    Raises
    ------
    ShapeError : when the axis has length 0, or leading axes do not broadcast.
    """
    axis, angle = _direction(axis), _check.array(angle, (), "angle")
    _check.broadcasts(axis=(axis, 1), angle=(angle, 0))
    return kernels.so3_exp(axis * angle[..., None])


def to_axis_angle(R: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Return axis and angle of a rotation; the axis of no turn is (0, 0, 1).

    At a half turn the first component of the axis that is not zero is positive.

    Parameters
    ----------
    R : (..., 3, 3).

    Returns
    -------
    axis : (..., 3) of length 1.
    angle : (...) in [0, π] [rad].

    Raises
    ------
    ShapeError : when R is not a rotation within `ROTATION_TOLERANCE`.
    """
    w = kernels.so3_log(R)
    length = _length(w)
    still = length == 0
    axis = np.where(still[..., None], (0.0, 0.0, 1.0), w / np.where(still, 1.0, length)[..., None])
    return axis, length


def _direction(axis: ArrayLike) -> np.ndarray:
    """(..., 3) the axis with length 1."""
    axis = _check.array(axis, (3,), "axis")
    length = _length(axis)
    bad = (length == 0) | (length == np.inf)
    if bad.any():
        raise ShapeError(f"Expected an axis with a direction, got {axis[bad][0]}. Leave such samples out.")
    return axis / length[..., None]


def _length(v: np.ndarray) -> np.ndarray:
    return np.hypot(np.hypot(v[..., 0], v[..., 1]), v[..., 2])


def _turn(sine: np.ndarray, cosine: np.ndarray) -> np.ndarray:
    """(...) atan2, NaN where both are lost in rounding."""
    return np.where(np.hypot(sine, cosine) < UNDEFINED, np.nan, np.arctan2(sine, cosine))[()]
