"""Inner messages of EgmRobot, read from their bytes: one `struct` call instead of an object for each message and array.

Each has one usual layout, which `struct` reads; any other layout that protobuf allows is parsed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from struct import Struct

from armlab.wire.egm import armlab_egm_pb2 as pb

__all__ = ["joint_reader", "read_pose", "read_state"]

_TAG = 0x09  # field 1, eight bytes
_POSE = Struct("<3sdBdBd3sdBdBdBd")
_POSE_TAGS = (b"\x0a\x1b\x09", 0x11, 0x19, b"\x12\x24\x09", 0x11, 0x19, 0x21)
_WITH_EULER = Struct(_POSE.format + "3sdBdBd")
_EULER_TAGS = (b"\x1a\x1b\x09", 0x11, 0x19)


def joint_reader(count: int) -> Callable[[bytes], Sequence[float]]:
    """Return a function from the bytes of an EgmJoints to its values. It raises DecodeError for bytes that are none.

    Parameters
    ----------
    count : how many values there usually are.
    """
    unpack, size, tags = Struct("<" + "Bd" * count).unpack, 9 * count, (_TAG,) * count

    def read(data: bytes) -> Sequence[float]:
        if len(data) == size:
            values = unpack(data)
            if values[::2] == tags:
                return values[1::2]
        return tuple(pb.EgmJoints.FromString(data).joints[:])

    return read


def read_pose(data: bytes) -> Sequence[float] | None:
    """Return x, y, z [mm] and u0 to u3 of an EgmPose, None without position and quaternion. Euler angles are not read.

    Parameters
    ----------
    data : bytes of the message.

    Raises
    ------
    DecodeError : they are none.
    """
    if len(data) == _POSE.size:
        values = _POSE.unpack(data)
        if values[::2] == _POSE_TAGS:
            return values[1::2]
    elif len(data) == _WITH_EULER.size:
        values = _WITH_EULER.unpack(data)
        if values[::2] == _POSE_TAGS + _EULER_TAGS:
            return values[1:14:2]
    pose = pb.EgmPose.FromString(data)
    if not (pose.HasField("pos") and pose.HasField("orient")):
        return None
    where, turn = pose.pos, pose.orient
    return where.x, where.y, where.z, turn.u0, turn.u1, turn.u2, turn.u3


def read_state(data: bytes) -> int:
    """Return the state in an EgmState, 0 when it is absent.

    Parameters
    ----------
    data : bytes of the message.

    Raises
    ------
    DecodeError : they are none.
    """
    if len(data) == 2 and data[0] == 0x08 and data[1] < 0x80:
        return data[1]
    return pb.EgmState.FromString(data).state
