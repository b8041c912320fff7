"""What goes to the robot, as the robot's side reads it and as bytes by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from armlab.wire.egm import Beside, EgmCodec, Reference, RobotSideCodec
from armlab.wire.egm.axes import AxisMap
from armlab.wire.egm.codec import Replies, encode_path_correction, encode_pose

T = np.array([[0.0, 0, 1, 0.4], [1, 0, 0, -0.05], [0, 1, 0, 0.3], [0, 0, 0, 1]])


def test_a_pose_byte_by_byte(wire: Any) -> None:
    """Quaternion (.5, .5, .5, .5) in millimetres, no Euler angles."""
    pose = wire.m(1, wire.d(1, 400.0), wire.d(2, -50.0), wire.d(3, 300.0))
    turn = wire.m(2, wire.d(1, 0.5), wire.d(2, 0.5), wire.d(3, 0.5), wire.d(4, 0.5))
    expected = wire.header(3, 4, 3) + wire.m(2, wire.m(2, pose, turn))
    assert encode_pose(T, None, 3, 4) == expected


def test_a_pose_is_that_of_another_program(vector: Any) -> None:
    twist = np.array([0.1, 0.2, 0.3, np.pi / 10, np.pi / 5, 0.3 * np.pi])
    ours, theirs = encode_pose(T, twist, 3, 4), vector("sensor_pose")
    assert ours[:-56] == theirs[:-56]
    speeds = [np.frombuffer(data[-54:], dtype=[("tag", "u1"), ("value", "<f8")]) for data in (ours, theirs)]
    assert speeds[0]["tag"].tolist() == speeds[1]["tag"].tolist() == [9] * 6
    np.testing.assert_allclose(speeds[0]["value"], speeds[1]["value"], rtol=1e-14)


def test_a_pose_with_its_speed_arrives(six: Any) -> None:
    twist = np.array([0.1, 0.2, 0.3, 1.0, 2.0, 3.0])
    message: Any = RobotSideCodec(six).decode_sensor(EgmCodec(six).encode_pose(T, twist, 2**32 + 5, 6))
    assert (message.seqno, message.tm_ms, message.mtype, message.q) == (5, 6, 3, None)
    np.testing.assert_allclose(message.T_frame_tool, T, atol=1e-15)
    np.testing.assert_allclose(message.twist, twist)


def test_a_path_correction_is_that_of_another_program(six: Any, wire: Any, vector: Any) -> None:
    theirs = wire.header(1, 0, 4)[2:]
    ours = encode_path_correction((1.5e-3, -2e-3), 0.04, 1, 0)
    assert ours == wire.m(1, theirs) + vector("path_correction")[6:]
    message: Any = RobotSideCodec(six).decode_sensor(EgmCodec(six).encode_path_correction((1.5e-3, -2e-3), 0.04, 1, 9))
    np.testing.assert_allclose(message.path_yz, [1.5e-3, -2e-3])
    assert (message.path_age, message.tm_ms, message.mtype) == (0.04, 9, 4)


def test_joints_with_and_without_speed(scara: Any, wire: Any) -> None:
    """A linear joint of a SCARA, in metres with the rotary factor where the user says so."""
    replies = Replies(AxisMap(scara, ("deg",) * 4), extension=False)
    q = np.radians([90.0, 0, 0, 0])
    assert replies.encode(Reference(q, None, None, 1, 2)) == wire.header(1, 2, 3) + wire.m(
        2, wire.m(1, wire.d(1, 90.0, 0, 0, 0))
    )
    assert len(replies.encode(Reference(q, q, None, 1, 2))) > 60


def test_everything_beside_the_joints_is_that_of_another_program(yumi: Any, wire: Any, vector: Any) -> None:
    """Axis 7, speeds, the digital value and numbers for RAPID, as ABBRobotEGM writes them; only our `tm` is more."""
    q, qd = np.radians([10, 20, 70, 30, 40, 50, 60]), np.radians([1.0, 2, 7, 3, 4, 5, 6])
    beside = Beside(rapid_data=np.array([7.0, 8.0]), rapid_digital=True)
    ours = RobotSideCodec(yumi).decode_sensor(EgmCodec(yumi).encode(Reference(q, qd, None, 5, 0, beside=beside)))
    theirs = RobotSideCodec(yumi).decode_sensor(vector("sensor"))
    for a, b in zip(ours[2:], theirs[2:], strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-14) if isinstance(a, np.ndarray) else None
        assert isinstance(a, np.ndarray) or a == b


def test_axes_beyond_the_robot_byte_by_byte(yumi: Any, wire: Any) -> None:
    """ABB's axis 7, then the axes beyond in degrees, or in millimetres where the user says so."""
    axes = AxisMap(yumi, ("deg",) * 7 + ("deg", "mm"))
    beside = Beside(np.array([np.pi / 2, 0.25]), np.array([0.0, 0.5]), np.array([2.5]), False)
    zeros = np.zeros(7)
    expected = (
        wire.header(1, 2, 3)
        + wire.m(2, wire.m(1, wire.d(1, *zeros[:6])), wire.m(3, wire.d(1, 0.0, 90.0, 250.0)))
        + wire.m(3, wire.m(1, wire.d(1, *zeros[:6])), wire.m(3, wire.d(1, 0.0, 0.0, 500.0)))
        + wire.m(4, wire.u(1, 0), wire.d(2, 2.5))
    )
    replies = Replies(axes, extension=False)
    assert replies.encode(Reference(zeros, zeros, None, 1, 2, beside=beside)) == expected
    assert len(replies.encode(Reference(zeros, zeros, None, 1, 2))) < len(expected) - 20, "nothing is left over"


@given(st.data())
def test_a_reply_written_is_the_reply_serialised(yumi: Any, data: st.DataObject) -> None:
    """The second of a kind is written into the bytes of the first, where integers may have had other lengths."""
    extension = data.draw(st.booleans())
    kept = Replies(AxisMap(yumi), extension)
    array = arrays(np.float64, 7, elements=st.floats(-1e3, 1e3))
    integer = st.one_of(st.integers(0, 200), st.integers(0, 2**64 - 1))
    for _ in range(4):
        q, qd, tau = data.draw(array), data.draw(st.none() | array), data.draw(st.none() | array)
        ref = Reference(q, qd, tau, *(data.draw(integer) for _ in range(4)), data.draw(st.booleans()))
        assert kept.encode(ref) == Replies(AxisMap(yumi), extension).encode(ref)
