"""Roll, pitch and yaw in the conventions zyx (ABB), xyz (Nikon) and zyz, and rotations about a single axis.

For angles (r, p, y), a convention lists the axes in the order of the product: zyx is ``Rz(r) Ry(p) Rx(y)``.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from armlab import kernels
from armlab.errors import UnknownName
from armlab.lie import arguments

__all__ = ["from_rpy", "rot_x", "rot_y", "rot_z", "to_rpy"]

Convention = Literal["zyx", "xyz", "zyz"]
CONVENTIONS = ("zyx", "xyz", "zyz")
AXES = {"zyx": (2, 1, 0), "xyz": (0, 1, 2), "zyz": (2, 1, 2)}


def rot_x(angle: ArrayLike) -> np.ndarray:
    """Return the rotation (..., 3, 3) about the x axis.

    Parameters
    ----------
    angle : (...) rotation angle [rad].
    """
    return _turn(angle, 0)


def rot_y(angle: ArrayLike) -> np.ndarray:
    """Return the rotation (..., 3, 3) about the y axis.

    Parameters
    ----------
    angle : (...) rotation angle [rad].
    """
    return _turn(angle, 1)


def rot_z(angle: ArrayLike) -> np.ndarray:
    """Return the rotation (..., 3, 3) about the z axis.

    Parameters
    ----------
    angle : (...) rotation angle [rad].
    """
    return _turn(angle, 2)


def from_rpy(rpy: ArrayLike, convention: Convention, out: np.ndarray | None = None) -> np.ndarray:
    """Return the rotation (..., 3, 3) with the given angles about the axes of a convention: ``R_1(r) R_2(p) R_3(y)``.

    Parameters
    ----------
    rpy : (..., 3) angles in the order of the product [rad].
    convention : "zyx", "xyz" or "zyz".
    out : (..., 3, 3) array for the result; default: newly allocated.

    Raises
    ------
    UnknownName : unknown convention.
    """
    return kernels.euler_from_rpy(rpy, *_axes(convention), out)


def to_rpy(R: ArrayLike, convention: Convention, out: np.ndarray | None = None) -> np.ndarray:
    """Return the angles (..., 3) [rad] of a rotation: ``from_rpy(to_rpy(R, c), c) = R``.

    The middle angle is in [-π/2, π/2] for zyx and xyz, and in [0, π] for zyz. If the first and last axes are parallel
    (gimbal lock), only the sum or difference of the first and last angles is determined. The first angle is then 0.

    Parameters
    ----------
    R : (..., 3, 3) rotation.
    convention : "zyx", "xyz" or "zyz".
    out : (..., 3) array for the result; default: newly allocated.

    Raises
    ------
    ShapeError : R is not a rotation within `so3.ROTATION_TOLERANCE`.
    UnknownName : unknown convention.
    """
    return kernels.euler_to_rpy(R, *_axes(convention), out)


def _axes(convention: str) -> tuple[int, int, int]:
    try:
        return AXES[convention]
    except (KeyError, TypeError):
        raise UnknownName.among("rotation convention", convention, CONVENTIONS) from None


def _turn(angle: ArrayLike, axis: int) -> np.ndarray:
    angle = arguments.array(angle, (), "angle")
    angles = np.zeros((*angle.shape, 3))
    angles[..., 0] = angle
    return kernels.euler_from_rpy(angles, axis, (axis + 1) % 3, axis)
