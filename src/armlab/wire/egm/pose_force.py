"""EgmPose and measuredForce: the parts of messages that both sides and `Details` read."""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, isfinite, nan, sin, sqrt
from typing import Any

import numpy as np

from armlab.wire.egm import armlab_egm_pb2 as pb
from armlab.wire.egm.axes import RADIAN

NO_POSE = (nan,) * 16
"""The values of a pose that was not sent."""


def pose_values(pose: Sequence[float]) -> tuple[float, ...]:
    """Return the 16 values, row by row, of a matrix [m]; `NO_POSE` for a quaternion without a usable norm.

    Plain arithmetic: ten times cheaper than small arrays. The quaternion is normalised.

    `pose`: x, y, z in mm, quaternion u0 (scalar) to u3.
    """
    x, y, z, a, b, c, d = pose
    norm = a * a + b * b + c * c + d * d
    if not 1e-12 < norm < 1e12:  # also NaN
        return NO_POSE
    s = 2.0 / norm
    b2, c2, d2 = s * b * b, s * c * c, s * d * d
    bc, bd, cd = s * b * c, s * b * d, s * c * d
    ab, ac, ad = s * a * b, s * a * c, s * a * d
    return (
        1.0 - c2 - d2, bc - ad, bd + ac, 1e-3 * x,
        bc + ad, 1.0 - b2 - d2, cd - ab, 1e-3 * y,
        bd - ac, cd + ab, 1.0 - b2 - c2, 1e-3 * z,
        0.0, 0.0, 0.0, 1.0,
    )  # fmt: skip


def read_pose(pose: Any, euler_wins: bool = False) -> tuple[float, ...] | None:
    """Return x, y, z [mm] and u0 to u3 of an EgmPose, None without a position and an orientation."""
    if euler_wins and pose.HasField("pos") and pose.HasField("euler"):
        x, y, z = (0.5 * RADIAN * angle for angle in (pose.euler.x, pose.euler.y, pose.euler.z))
        if not isfinite(x + y + z):
            return pose.pos.x, pose.pos.y, pose.pos.z, nan, nan, nan, nan
        (a, b), (c, d), (e, f) = ((cos(half), sin(half)) for half in (x, y, z))
        turned = a * c * e + b * d * f, b * c * e - a * d * f, a * d * e + b * c * f, a * c * f - b * d * e
        return (pose.pos.x, pose.pos.y, pose.pos.z, *turned)
    if not (pose.HasField("pos") and pose.HasField("orient")):
        return None
    where, turn = pose.pos, pose.orient
    return where.x, where.y, where.z, turn.u0, turn.u1, turn.u2, turn.u3


def pose_from_matrix(pose: Any, T_frame_tool: np.ndarray) -> None:
    """Write a (4, 4) matrix [m] into an EgmPose message: position in mm and the quaternion with u0 >= 0.

    `T_frame_tool`: (4, 4) rigid transformation.
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


_RW7_TAGS = (b"\x08", b"\x11", b"\x12")  # field 1 bool; field 2 doubles, unpacked or packed


def is_layout_of_rw7(data: bytes) -> bool:
    """Return whether a measuredForce has the layout of RobotWare 7, by its first tag."""
    return data[:1] in _RW7_TAGS


def encode_force(wrench: np.ndarray, is_rw7: bool) -> bytes:
    """Return the bytes of measuredForce in the layout of RobotWare 6 or 7.

    `wrench`: (6,) N, N m.
    """
    message = pb.EgmForceRw7(fcActive=True) if is_rw7 else pb.EgmForceRw6()
    message.force.extend(wrench.tolist())
    return message.SerializeToString()
