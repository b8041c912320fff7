"""measuredForce: RobotWare 6 and 7 number its fields differently, and a decoder of the wrong one returns nothing."""

from __future__ import annotations

from math import nan

import numpy as np
from google.protobuf.message import DecodeError

from armlab.wire.egm import armlab_egm_pb2 as pb

__all__ = ["NO_WRENCH", "decode_force", "encode_force", "is_layout_of_rw7"]

NO_WRENCH = (nan,) * 6
"""The values of a force that was not sent."""

_RW6_TAGS = (b"\x09", b"\x0a")  # field 1 doubles, unpacked or packed
_RW7_TAGS = (b"\x08", b"\x11", b"\x12")  # field 1 bool; field 2 doubles, unpacked or packed


def is_layout_of_rw7(data: bytes) -> bool:
    """Return whether a measuredForce has the layout of RobotWare 7, by its first tag.

    Parameters
    ----------
    data : content of the field.
    """
    return data[:1] in _RW7_TAGS


def decode_force(data: bytes) -> tuple[tuple[float, ...], bool]:
    """Return the 6 values of the wrench [N, N m] and whether the layout is that of RobotWare 7.

    `NO_WRENCH` when there is none. The first tag byte tells the layout. Frame and sign are not documented by ABB.

    Parameters
    ----------
    data : content of the field measuredForce.
    """
    if data[:1] not in _RW6_TAGS + _RW7_TAGS:
        return NO_WRENCH, False
    is_rw7 = is_layout_of_rw7(data)
    try:
        force = (pb.EgmForceRw7 if is_rw7 else pb.EgmForceRw6).FromString(data).force[:]
    except DecodeError:
        return NO_WRENCH, False
    return (tuple(force) if len(force) == 6 else NO_WRENCH), is_rw7


def encode_force(wrench: np.ndarray, is_rw7: bool) -> bytes:
    """Return the bytes of measuredForce in the layout of RobotWare 6 or 7.

    Parameters
    ----------
    wrench : (6,) N, N m. is_rw7 : True for the layout of RobotWare 7.
    """
    message = pb.EgmForceRw7(fcActive=True) if is_rw7 else pb.EgmForceRw6()
    message.force.extend(wrench.tolist())
    return message.SerializeToString()
