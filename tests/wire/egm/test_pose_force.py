"""EgmPose and measuredForce."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armlab.wire.egm import armlab_egm_pb2 as pb
from armlab.wire.egm.pose_force import (
    NO_POSE,
    NO_WRENCH,
    decode_force,
    encode_force,
    is_layout_of_rw7,
    pose_from_matrix,
    pose_values,
    read_pose,
)


def written(message: pb.EgmPose) -> np.ndarray:
    where, turn = message.pos, message.orient
    return np.reshape(pose_values((where.x, where.y, where.z, turn.u0, turn.u1, turn.u2, turn.u3)), (4, 4))


def test_millimetres_and_scalar_first() -> None:
    """A quarter turn about z is (cos 45, 0, 0, sin 45); x goes to y."""
    half = np.sqrt(0.5)
    T = np.reshape(pose_values((400.0, -50.0, 300.0, half, 0.0, 0.0, half)), (4, 4))
    expected = [[0, -1, 0, 0.4], [1, 0, 0, -0.05], [0, 0, 1, 0.3], [0, 0, 0, 1]]
    np.testing.assert_allclose(T, expected, atol=1e-15)


unit = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda u: sum(x * x for x in u) > 1e-3)


@given(unit, st.tuples(*[st.floats(-3, 3)] * 3))
def test_round_trip(quaternion: tuple[float, ...], position: tuple[float, ...]) -> None:
    T = np.reshape(pose_values((*(1e3 * x for x in position), *quaternion)), (4, 4))
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    message = pb.EgmPose()
    pose_from_matrix(message, T)
    assert message.orient.u0 >= 0.0
    assert not message.HasField("euler")
    np.testing.assert_allclose(written(message), T, atol=1e-12)


@pytest.mark.parametrize("turn", [(0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)])
def test_half_turns(turn: tuple[float, ...]) -> None:
    T = np.reshape(pose_values((0, 0, 0, *turn)), (4, 4))
    message = pb.EgmPose()
    pose_from_matrix(message, T)
    np.testing.assert_allclose(written(message), T, atol=1e-12)


@pytest.mark.parametrize("quaternion", [(0, 0, 0, 0), (np.nan, 0, 0, 0), (np.inf, 0, 0, 0)])
def test_an_unusable_quaternion_is_no_pose(quaternion: tuple[float, ...]) -> None:
    assert pose_values((0, 0, 0, *quaternion)) is NO_POSE
    assert np.isnan(NO_POSE).all()


def test_a_pose_without_position_or_quaternion_is_none() -> None:
    where, turn = pb.EgmCartesian(x=1, y=2, z=3), pb.EgmQuaternion(u0=1)
    euler = pb.EgmEuler(x=90)
    assert read_pose(pb.EgmPose(pos=where, orient=turn, euler=euler)) == (1, 2, 3, 1, 0, 0, 0)
    for message in (pb.EgmPose(), pb.EgmPose(pos=where, euler=euler), pb.EgmPose(orient=turn)):
        assert read_pose(message) is None


def test_euler_angles_win_where_the_controller_reads() -> None:
    """A rotation about x, then y, then z of the frame; without them, or for us, the quaternion counts."""
    pose = pb.EgmPose(
        pos=pb.EgmCartesian(x=1.0, y=2.0, z=3.0),
        orient=pb.EgmQuaternion(u0=1.0, u1=0.0, u2=0.0, u3=0.0),
        euler=pb.EgmEuler(x=30.0, y=-50.0, z=110.0),
    )
    assert read_pose(pose) == (1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0)
    (cx, sx), (cy, sy), (cz, sz) = ((np.cos(a), np.sin(a)) for a in np.radians([30.0, -50.0, 110.0]))
    turn_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    turn_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    turn_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    found = read_pose(pose, euler_wins=True)
    assert found is not None
    np.testing.assert_allclose(np.reshape(pose_values(found), (4, 4))[:3, :3], turn_z @ turn_y @ turn_x, atol=1e-15)
    pose.ClearField("orient")
    assert read_pose(pose) is None
    assert read_pose(pose, euler_wins=True) == found
    pose.euler.x = np.inf
    assert np.isnan(read_pose(pose, euler_wins=True)[3:]).all()  # type: ignore[index]


FORCE = (1.0, -2.0, 3.5, 0.1, 0.2, -0.3)
DOUBLES = [struct.pack("<d", value) for value in FORCE]


@pytest.mark.parametrize(
    ("data", "is_rw7"),
    [
        (b"".join(b"\x09" + d for d in DOUBLES), False),
        (b"\x0a\x30" + b"".join(DOUBLES), False),
        (b"\x08\x01" + b"".join(b"\x11" + d for d in DOUBLES), True),
        (b"".join(b"\x11" + d for d in DOUBLES), True),
        (b"\x12\x30" + b"".join(DOUBLES), True),
        (b"".join(b"\x11" + d for d in DOUBLES) + b"\x08\x00", True),
    ],
    ids=["rw6 unpacked", "rw6 packed", "rw7", "rw7 without fcActive", "rw7 packed", "rw7 other order"],
)
def test_the_first_tag_tells_the_layout(data: bytes, is_rw7: bool) -> None:
    assert decode_force(data) == (FORCE, is_rw7)
    assert is_layout_of_rw7(data) == is_rw7


@pytest.mark.parametrize(
    "data", [b"", b"\x09", b"\xff\xff", b"\x09" + DOUBLES[0], b"\x1a\x00", b"\x0a\x7f"], ids=lambda data: data.hex()
)
def test_what_is_no_force_is_nan(data: bytes) -> None:
    assert decode_force(data) == (NO_WRENCH, False)
    assert np.isnan(NO_WRENCH).all()


def test_force_control_without_values_still_tells_the_version() -> None:
    assert decode_force(b"\x08\x00") == (NO_WRENCH, True)


@pytest.mark.parametrize("is_rw7", [False, True])
def test_round_trip_in_force(is_rw7: bool) -> None:
    assert decode_force(encode_force(np.array(FORCE), is_rw7)) == (FORCE, is_rw7)


@given(st.binary(max_size=80))
def test_never_raises(data: bytes) -> None:
    result: Any = decode_force(data)
    assert len(result[0]) == 6
