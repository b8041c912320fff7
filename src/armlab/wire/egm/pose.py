"""EgmPose and homogeneous matrices: millimetres and a scalar-first quaternion on the wire, metres in the API."""

from __future__ import annotations

from math import sqrt
from typing import Any

import numpy as np

__all__ = ["NO_POSE", "matrix_from_pose", "pose_from_matrix"]

NO_POSE = np.full((4, 4), np.nan)
NO_POSE.flags.writeable = False


def matrix_from_pose(pose: Any) -> np.ndarray:
    """Return the (4, 4) matrix of an EgmPose [m], `NO_POSE` without a position and a usable quaternion.

    Plain arithmetic: ten times cheaper than small arrays. The quaternion is normalised. Euler angles are not read.

    Parameters
    ----------
    pose : an EgmPose message.
    """
    if not (pose.HasField("pos") and pose.HasField("orient")):
        return NO_POSE
    pos, orient = pose.pos, pose.orient
    x, y, z = pos.x, pos.y, pos.z
    a, b, c, d = orient.u0, orient.u1, orient.u2, orient.u3
    norm = a * a + b * b + c * c + d * d
    if not 1e-12 < norm < 1e12:  # also NaN
        return NO_POSE
    s = 2.0 / norm
    return np.array(
        (
            (1.0 - s * (c * c + d * d), s * (b * c - a * d), s * (b * d + a * c), 1e-3 * x),
            (s * (b * c + a * d), 1.0 - s * (b * b + d * d), s * (c * d - a * b), 1e-3 * y),
            (s * (b * d - a * c), s * (c * d + a * b), 1.0 - s * (b * b + c * c), 1e-3 * z),
            (0.0, 0.0, 0.0, 1.0),
        )
    )


def pose_from_matrix(pose: Any, T_frame_tool: np.ndarray) -> None:
    """Write a (4, 4) matrix [m] into an EgmPose message: position in mm and the quaternion with u0 >= 0.

    Parameters
    ----------
    pose : an EgmPose message. T_frame_tool : (4, 4) rigid transformation.
    """
    (r00, r01, r02, x), (r10, r11, r12, y), (r20, r21, r22, z) = T_frame_tool.tolist()[:3]
    pos, orient = pose.pos, pose.orient
    pos.x, pos.y, pos.z = 1e3 * x, 1e3 * y, 1e3 * z
    # Each candidate is 4 u_i times the quaternion; the largest u_i keeps the division well conditioned.
    squares = (1 + r00 + r11 + r22, 1 + r00 - r11 - r22, 1 - r00 + r11 - r22, 1 - r00 - r11 + r22)
    largest = max(range(4), key=squares.__getitem__)
    candidates = (
        (squares[0], r21 - r12, r02 - r20, r10 - r01),
        (r21 - r12, squares[1], r01 + r10, r02 + r20),
        (r02 - r20, r01 + r10, squares[2], r12 + r21),
        (r10 - r01, r02 + r20, r12 + r21, squares[3]),
    )
    factor = 0.5 / sqrt(squares[largest])
    if candidates[largest][0] < 0:
        factor = -factor
    orient.u0, orient.u1, orient.u2, orient.u3 = (factor * value for value in candidates[largest])
