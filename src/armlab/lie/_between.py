"""Poses between poses: paths and means."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from armlab import kernels
from armlab._numbers import check_name
from armlab.lie import so3
from armlab.lie._mean import shares

PATHS = ("linear", "screw")


def assemble(R: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Return the pose of a rotation and a position."""
    T = np.zeros((*np.broadcast_shapes(R.shape[:-2], p.shape[:-1]), 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R, p, 1.0
    return T


def interpolate(
    T_a: ArrayLike,
    T_b: ArrayLike,
    s: ArrayLike,
    path: Literal["linear", "screw"] = "linear",
    out: np.ndarray | None = None,
) -> np.ndarray:
    """Move from a to b: the position along a line, the rotation about one axis, both at constant speed.

    The screw path is ``T_a exp(s log(T_a⁻¹ T_b))`` instead: it does not depend on the point of the body that is
    looked at, and that point moves along a helix. Both ends are exact.

    Parameters
    ----------
    T_a, T_b : (..., 4, 4) poses in one frame, leading axes broadcast with those of s.
    s : (...) 0 at a, 1 at b.
    path : "linear" or "screw".
    out : (..., 4, 4) array to write into.

    Returns
    -------
    (..., 4, 4).

    Raises
    ------
    ShapeError : when one is not a pose within `so3.ROTATION_TOLERANCE`.
    UnknownName : when the path does not exist.
    """
    check_name(path, "path between poses", PATHS)
    return kernels.se3_interpolate(T_a, T_b, s, path == "screw", out)


def mean(
    T: ArrayLike, weights: ArrayLike | None = None, method: Literal["chordal", "geodesic"] = "chordal"
) -> np.ndarray:
    """Return the mean of poses along axis 0: the mean position and `so3.mean` of the rotations.

    It depends on the point whose positions are averaged, the origin of the moving frame.

    Parameters
    ----------
    T : (N, ..., 4, 4), N ≥ 1.
    weights : (N,) or (N, ...), not negative; equal when None. 0 leaves a pose out, also one that is missing.
    method : "chordal" or "geodesic", of the rotations.

    Returns
    -------
    (..., 4, 4).

    Raises
    ------
    ShapeError, NotConverged, UnknownName : as `so3.mean`.
    """
    T = kernels.poses(T, "T")
    R = so3.mean(T[..., :3, :3], weights, method)
    share = shares(weights, T.shape[:-2])[..., None]
    return assemble(R, (share * np.where(share > 0, T[..., :3, 3], 0.0)).sum(axis=0))
