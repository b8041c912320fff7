"""Roll, pitch, yaw in the conventions zyx (ABB), xyz (Nikon) and zyz, and turns about one axis.

With angles (r, p, y) a convention names the axes in the order of the product: zyx is ``Rz(r) Ry(p) Rx(y)``.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from armlab import kernels
from armlab.errors import UnknownName
from armlab.lie import _check

__all__ = ["CONVENTIONS", "Convention", "from_rpy", "rot_x", "rot_y", "rot_z", "to_rpy"]

Convention = Literal["zyx", "xyz", "zyz"]
CONVENTIONS = ("zyx", "xyz", "zyz")
LOCK = 1e-13  # below, the first and the last axis are parallel to the last digit


def rot_x(angle: ArrayLike) -> np.ndarray:
    """Return the turn about x.

    Parameters
    ----------
    angle : (...) [rad].

    Returns
    -------
    (..., 3, 3).
    """
    return _turn(angle, 0)


def rot_y(angle: ArrayLike) -> np.ndarray:
    """Return the turn about y.

    Parameters
    ----------
    angle : (...) [rad].

    Returns
    -------
    (..., 3, 3).
    """
    return _turn(angle, 1)


def rot_z(angle: ArrayLike) -> np.ndarray:
    """Return the turn about z.

    Parameters
    ----------
    angle : (...) [rad].

    Returns
    -------
    (..., 3, 3).
    """
    return _turn(angle, 2)


def from_rpy(rpy: ArrayLike, convention: Convention) -> np.ndarray:
    """Return the rotation ``R_1(r) R_2(p) R_3(y)`` about the axes that the convention names.

    Parameters
    ----------
    rpy : (..., 3) angles in the order of the product [rad].
    convention : "zyx", "xyz" or "zyz".

    Returns
    -------
    (..., 3, 3).

    Raises
    ------
    UnknownName : when the convention does not exist.
    """
    rpy = _check.array(rpy, (3,), "rpy")
    first, middle, last = (_turn(rpy[..., k], axis) for k, axis in enumerate(_axes(convention)))
    return first @ middle @ last


def to_rpy(R: ArrayLike, convention: Convention) -> np.ndarray:
    """Return the angles with ``from_rpy(to_rpy(R, c), c) = R``.

    The middle angle is in [-π/2, π/2] for zyx and xyz, in [0, π] for zyz. Where the first and the last axis are
    parallel (gimbal lock) only their sum or difference is determined: the first angle is 0, the last takes it all.

    Parameters
    ----------
    R : (..., 3, 3).
    convention : "zyx", "xyz" or "zyz".

    Returns
    -------
    (..., 3) [rad].

    Raises
    ------
    ShapeError : when R is not a rotation within `so3.ROTATION_TOLERANCE`.
    UnknownName : when the convention does not exist.
    """
    i, j, last = _axes(convention)
    R = kernels.rotations(R, "R")
    k = 3 - i - j
    e = 1.0 if (j - i) % 3 == 1 else -1.0  # e_i × e_j = e e_k
    if last == i:  # column i of R is what the first two turns make of axis i
        sine, cosine = R[..., j, i], -e * R[..., k, i]
        middle = np.arctan2(np.hypot(sine, cosine), R[..., i, i])
    else:
        sine, cosine = -e * R[..., j, k], R[..., k, k]
        middle = np.arctan2(e * R[..., i, k], np.hypot(sine, cosine))
    first = np.where(np.hypot(sine, cosine) < LOCK, 0.0, np.arctan2(sine, cosine))
    # Row j after the first turn is undone holds the last turn alone, so lock does not touch it.
    row = np.cos(first)[..., None] * R[..., j, :] + e * np.sin(first)[..., None] * R[..., k, :]
    about = e * row[..., i] if last != i else -e * row[..., k]
    return np.stack([first, middle, np.arctan2(about, row[..., j])], axis=-1)


def _axes(convention: str) -> tuple[int, int, int]:
    if convention not in CONVENTIONS:
        raise UnknownName.among("rotation convention", convention, CONVENTIONS)
    first, middle, last = ("xyz".index(letter) for letter in convention)
    return first, middle, last


def _turn(angle: ArrayLike, axis: int) -> np.ndarray:
    angle = np.asarray(angle, dtype=np.float64)
    c, s = np.cos(angle), np.sin(angle)
    R = np.zeros((*angle.shape, 3, 3))
    j, k = (axis + 1) % 3, (axis + 2) % 3
    R[..., axis, axis] = 1.0
    R[..., j, j], R[..., k, k], R[..., j, k], R[..., k, j] = c, c, -s, s
    return R
