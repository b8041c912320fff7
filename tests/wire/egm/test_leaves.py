"""Inner messages from their bytes: the usual layout, and every other that protobuf allows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from google.protobuf.message import DecodeError
from hypothesis import given
from hypothesis import strategies as st

from armlab.wire.egm import armlab_egm_pb2 as pb
from armlab.wire.egm.leaves import joint_reader, read_pose, read_state

SIX = (1.0, -2.0, 3.0, 4.0, 5.0, 6.0)


def test_joints_in_every_layout(wire: Any) -> None:
    read = joint_reader(6)
    assert tuple(read(wire.d(1, *SIX))) == SIX
    assert tuple(read(wire.packed(1, *SIX))) == SIX
    assert tuple(read(wire.d(1, *SIX[:5]))) == SIX[:5]
    assert tuple(read(wire.u(9, 1) + wire.d(1, *SIX))) == SIX
    assert tuple(read(wire.d(1, *SIX[:5]) + wire.d(2, 9.0))) == SIX[:5]
    assert tuple(read(b"")) == ()
    assert tuple(joint_reader(0)(b"")) == ()


POSITION, TURN = (400.0, -50.0, 300.0), (0.5, 0.5, -0.5, 0.5)


def test_pose_in_every_layout(wire: Any) -> None:
    where = wire.m(1, *(wire.d(k + 1, value) for k, value in enumerate(POSITION)))
    turn = wire.m(2, *(wire.d(k + 1, value) for k, value in enumerate(TURN)))
    backwards = wire.m(1, *(wire.d(k + 1, POSITION[k]) for k in (2, 1, 0)))
    euler = wire.m(3, wire.d(1, 90.0))
    for data in (where + turn, where + turn + euler, turn + where, backwards + turn, euler + where + turn):
        assert read_pose(data) == (*POSITION, *TURN)
    for data in (b"", where, turn, where + euler):
        assert read_pose(data) is None
    moved = wire.m(1, wire.d(1, 7.0))
    assert read_pose(where + turn + moved) == (7.0, *POSITION[1:], *TURN)


@pytest.mark.parametrize(
    ("data", "value"), [(b"", 0), (b"\x08\x03", 3), (b"\x08\x80\x01", 128), (b"\x10\x01", 0), (b"\x08\x01\x10\x05", 1)]
)
def test_states(data: bytes, value: int) -> None:
    assert read_state(data) == value


def parsed_joints(data: bytes) -> Any:
    return tuple(pb.EgmJoints.FromString(data).joints)


def parsed_pose(data: bytes) -> Any:
    pose = pb.EgmPose.FromString(data)
    if not (pose.HasField("pos") and pose.HasField("orient")):
        return None
    p, o = pose.pos, pose.orient
    return p.x, p.y, p.z, o.u0, o.u1, o.u2, o.u3


READERS: list[tuple[Callable[[bytes], Any], Callable[[bytes], Any], bytes]] = [
    (joint_reader(6), parsed_joints, pb.EgmJoints(joints=SIX).SerializeToString()),
    (
        read_pose,
        parsed_pose,
        pb.EgmPose(
            pos=pb.EgmCartesian(x=1, y=2, z=3), orient=pb.EgmQuaternion(u0=1, u1=2, u2=3, u3=4), euler=pb.EgmEuler(x=1)
        ).SerializeToString(),
    ),
    (read_state, lambda data: pb.EgmState.FromString(data).state, pb.EgmState(state=3).SerializeToString()),
]


@pytest.mark.parametrize("which", range(len(READERS)))
@given(st.data())
def test_any_bytes_read_as_protobuf_reads_them(which: int, data: st.DataObject) -> None:
    """Mutated messages: the same values as the parser gives, or the same refusal."""
    read, parse, good = READERS[which]
    mutated = bytearray(good)
    for _ in range(data.draw(st.integers(0, 4))):
        where = data.draw(st.integers(0, len(mutated)))
        mutated[where : where + data.draw(st.integers(0, 9))] = data.draw(st.binary(max_size=9))
    try:
        expected = parse(bytes(mutated))
    except DecodeError:
        with pytest.raises(DecodeError):
            read(bytes(mutated))
        return
    found = read(bytes(mutated))
    if isinstance(expected, tuple):
        np.testing.assert_array_equal(found, expected)
    else:
        assert found == expected
