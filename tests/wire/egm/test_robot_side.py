"""The robot's side of the wire, and both sides together."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armlab.errors import ConfigError, UnknownName
from armlab.wire.egm import Drop, EgmCodec, Packet, Reference
from armlab.wire.egm import armlab_egm_pb2 as pb
from armlab.wire.egm.robot_side import (
    DEFAULT_ARRAYS,
    EXTENSION_ARRAYS,
    MAX_BYTES,
    ROBOTWARE,
    RobotMessage,
    RobotSideCodec,
    SensorMessage,
)

finite = st.floats(-1e3, 1e3)


def heard(found: SensorMessage | Drop) -> SensorMessage:
    assert isinstance(found, SensorMessage), found
    return found


@pytest.mark.parametrize("robotware", ROBOTWARE)
@pytest.mark.parametrize("extension", [False, True])
@given(st.data())
@settings(max_examples=15)
def test_robot_to_bridge(yumi: Any, robotware: str, extension: bool, data: st.DataObject) -> None:
    vector = st.lists(finite, min_size=7, max_size=7).map(np.array)
    q, planned, qd, tau = (data.draw(vector) for _ in range(4))
    seq, tm = data.draw(st.integers(0, 2**32 - 1)), data.draw(st.integers(0, 2**32 - 1))
    T = np.eye(4)
    T[:3, 3] = [1.0, 2.0, 3.0]
    message = RobotMessage(
        seq, tm, q, planned, 1_700_000_000_123_456_000, (0.5,), T, 1, 3, 0, True, 33.0, np.arange(6.0), qd=qd, tau=tau
    )
    packet = EgmCodec(yumi).decode(RobotSideCodec(yumi, robotware, extension).encode_robot(message))
    assert isinstance(packet, Packet)
    assert (packet.seqno, packet.tm_ms, packet.robotware) == (seq, tm, robotware)
    assert (packet.motors, packet.mci, packet.rapid, packet.converged) == (1, 3, 0, True)
    np.testing.assert_allclose(packet.q, q, rtol=1e-14)
    np.testing.assert_allclose(packet.q_planned, planned, rtol=1e-14)
    np.testing.assert_allclose(packet.q_ext, [0.5])
    np.testing.assert_allclose(packet.T_frame_tool, T, atol=1e-15)
    assert packet.robot_ns == (0 if robotware == "6.06" else 1_700_000_000_123_456_000)
    wrench = np.full(6, np.nan) if robotware in ("6.06", "6.07") else message.wrench_raw
    np.testing.assert_array_equal(packet.wrench_raw, wrench)
    if extension:
        np.testing.assert_allclose(packet.qd, qd, rtol=1e-14)
        np.testing.assert_array_equal(packet.tau, tau)
    else:
        assert (packet.qd, packet.tau) == (None, None)


@given(st.data())
@settings(max_examples=30)
def test_bridge_to_robot(yumi: Any, data: st.DataObject) -> None:
    vector = st.lists(finite, min_size=7, max_size=7).map(np.array)
    q, qd = data.draw(vector), data.draw(vector)
    message = heard(RobotSideCodec(yumi).decode_sensor(EgmCodec(yumi).encode(Reference(q, qd, None, 9, 8))))
    np.testing.assert_allclose(message.q, q, rtol=1e-14)
    np.testing.assert_allclose(message.qd, qd, rtol=1e-14)
    assert (message.seqno, message.tm_ms, message.mtype, message.echo_seq) == (9, 8, 3, None)


def test_feedback_of_old_versions_is_in_radians_and_commands_in_degrees(six: Any, wire: Any) -> None:
    q = np.array([0.5, 0, 0, 0, 0, 0])
    old = RobotSideCodec(six, "6.06")
    data = old.encode_robot(RobotMessage(0, 0, q, converged=None, motors=None, mci=None, rapid=None))
    assert data == wire.header() + wire.m(2, wire.m(1, wire.d(1, *q)))
    reply = wire.header(mtype=3) + wire.m(2, wire.m(1, wire.d(1, 90.0, 0, 0, 0, 0, 0)))
    np.testing.assert_allclose(heard(old.decode_sensor(reply)).q, [np.pi / 2, 0, 0, 0, 0, 0])


def test_references_of_external_axes_are_in_degrees(yumi: Any, wire: Any) -> None:
    planned = wire.m(2, wire.m(1, wire.d(1, *[0.0] * 6)), wire.m(3, wire.d(1, 180.0, 90.0, -45.0)))
    message = heard(RobotSideCodec(yumi).decode_sensor(wire.header(mtype=3) + planned))
    np.testing.assert_allclose(message.q, [0, 0, np.pi, 0, 0, 0, 0])
    np.testing.assert_allclose(message.q_ext, [np.pi / 2, -np.pi / 4])


def test_messages_of_another_program(yumi: Any, vector: Callable[[str], bytes]) -> None:
    codec = RobotSideCodec(yumi)
    message = heard(codec.decode_sensor(vector("sensor")))
    np.testing.assert_allclose(message.q, np.radians([10, 20, 70, 30, 40, 50, 60]))
    np.testing.assert_allclose(message.qd, np.radians([1, 2, 7, 3, 4, 5, 6]))
    assert (message.seqno, message.tm_ms) == (5, None)
    assert message.rapid_data is not None
    assert (message.rapid_data.tolist(), message.rapid_digital) == ([7, 8], True)
    correction = heard(codec.decode_sensor(vector("path_correction")))
    assert correction.mtype == 4
    np.testing.assert_allclose(correction.path_yz, [1.5e-3, -2e-3])
    assert correction.path_age == pytest.approx(0.04)


def test_pose_and_joints_together(six: Any, wire: Any) -> None:
    """abb_libegm sends both, and also Euler angles."""
    pose = wire.m(1, wire.d(1, 100.0), wire.d(2, 0.0), wire.d(3, 0.0)) + wire.m(2, wire.d(1, 1.0), wire.d(2, 0.0))
    planned = wire.m(2, wire.m(1, wire.d(1, *range(6))), wire.m(2, pose))
    speed = wire.m(3, wire.m(2, wire.d(1, 1000.0, 0, 0, 180.0, 0, 0)))
    message = heard(RobotSideCodec(six).decode_sensor(wire.header(mtype=3) + planned + speed))
    assert message.q is not None
    assert message.T_frame_tool is not None
    assert message.T_frame_tool[0, 3] == pytest.approx(0.1)
    np.testing.assert_allclose(message.twist, [1, 0, 0, np.pi, 0, 0])


def test_drops(yumi: Any, wire: Any) -> None:
    codec = RobotSideCodec(yumi)
    five = wire.m(2, wire.m(1, wire.d(1, *range(5))))
    for data, reason in [
        (b"", "no header"),
        (b"\xff", "unparsable"),
        (wire.header(mtype=2), "wrong type"),
        (wire.header(mtype=3) + five, "joint count"),
        (wire.header(mtype=4) + wire.m(2, wire.m(1, b"\xff")), "unparsable"),
    ]:
        found = codec.decode_sensor(data)
        assert isinstance(found, Drop)
        assert found.reason == reason


def test_nan_is_left_to_the_robot(six: Any, wire: Any) -> None:
    data = wire.header(mtype=3) + wire.m(2, wire.m(1, wire.d(1, *[np.nan] * 6)))
    assert np.isnan(heard(RobotSideCodec(six).decode_sensor(data)).q).all()


@given(st.binary(max_size=300))
def test_any_bytes(yumi: Any, data: bytes) -> None:
    assert isinstance(RobotSideCodec(yumi).decode_sensor(data), SensorMessage | Drop)


def test_configurations_above_the_limit_are_refused_by_name(yumi: Any) -> None:
    RobotSideCodec(yumi, "6.10", EXTENSION_ARRAYS)
    RobotSideCodec(yumi, "7", DEFAULT_ARRAYS)
    with pytest.raises(ConfigError, match=rf"{MAX_BYTES} bytes.*qd_reference, q_reference"):
        RobotSideCodec(yumi, "7", EXTENSION_ARRAYS, force=True, data=20)
    with pytest.raises(ConfigError, match="external axes and the RAPID data"):
        RobotSideCodec(yumi, "7", force=True, external=5, data=60)


def test_the_promised_size_is_never_exceeded(yumi: Any) -> None:
    rng = np.random.default_rng(1)
    codec = RobotSideCodec(yumi, "7", True, force=True)
    a = rng.normal(size=(6, 7))
    message = RobotMessage(
        2**32 - 1, 2**32 - 1, a[0], a[1], 2**62, (), np.eye(4), wrench_raw=np.ones(6), rapid_digital=True,
        tau_reference=a[2], qd=a[2], tau=a[3], tau_total=a[4], tau_gravity=a[5], mono_ns=2**62, used_seq=2**32 - 1,
        queue_depth=64, overruns=2**31,
    )  # fmt: skip
    assert len(codec.encode_robot(message)) <= MAX_BYTES


def test_wrong_names(six: Any) -> None:
    with pytest.raises(ConfigError, match=r"6.06, 6.07, 6.10, 7, got '5'"):
        RobotSideCodec(six, "5")
    with pytest.raises(UnknownName, match="tau_gravity"):
        RobotSideCodec(six, extension=("gravity",))


unit = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda u: sum(x * x for x in u) > 1e-3)
half_turn = st.sampled_from([(0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0)])


@given(unit | half_turn, st.tuples(*[st.floats(-3, 3)] * 3))
def test_poses_arrive(six: Any, quaternion: tuple[float, ...], position: tuple[float, ...]) -> None:
    a, b, c, d = np.array(quaternion) / np.linalg.norm(quaternion)
    cross = np.array([[0, -d, c], [d, 0, -b], [-c, b, 0]])
    T = np.eye(4)
    T[:3, :3] += 2 * a * cross + 2 * cross @ cross
    T[:3, 3] = position
    data = EgmCodec(six).encode_pose(T, None, 1, 2)
    pose = pb.EgmSensor.FromString(data).planned.cartesian
    assert pose.orient.u0 >= 0.0
    assert not pose.HasField("euler")
    np.testing.assert_allclose(heard(RobotSideCodec(six).decode_sensor(data)).T_frame_tool, T, atol=1e-12)


def told(six: Any, pose: pb.EgmPose) -> np.ndarray | None:
    sensor = pb.EgmSensor(header=pb.EgmHeader(mtype=3), planned=pb.EgmMotion(cartesian=pose))
    return heard(RobotSideCodec(six).decode_sensor(sensor.SerializeToString())).T_frame_tool


@pytest.mark.parametrize("quaternion", [(0, 0, 0, 0), (np.nan, 0, 0, 0), (np.inf, 0, 0, 0)])
def test_an_unusable_quaternion_is_no_pose(six: Any, quaternion: tuple[float, ...]) -> None:
    turn = pb.EgmQuaternion(**dict(zip(("u0", "u1", "u2", "u3"), quaternion, strict=True)))
    assert np.isnan(told(six, pb.EgmPose(pos=pb.EgmCartesian(x=1.0, y=2.0, z=3.0), orient=turn))).all()  # type: ignore[arg-type]


def test_euler_angles_win_where_the_controller_reads(six: Any) -> None:
    pose = pb.EgmPose(
        pos=pb.EgmCartesian(x=1.0, y=2.0, z=3.0),
        orient=pb.EgmQuaternion(u0=1.0, u1=0.0, u2=0.0, u3=0.0),
        euler=pb.EgmEuler(x=30.0, y=-50.0, z=110.0),
    )
    (cx, sx), (cy, sy), (cz, sz) = ((np.cos(a), np.sin(a)) for a in np.radians([30.0, -50.0, 110.0]))
    turn_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    turn_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    turn_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    for _ in range(2):
        T: Any = told(six, pose)
        np.testing.assert_allclose(T[:3, :3], turn_z @ turn_y @ turn_x, atol=1e-15)
        np.testing.assert_allclose(T[:3, 3], [1e-3, 2e-3, 3e-3])
        pose.ClearField("orient")
    pose.euler.x = np.inf
    assert np.isnan(told(six, pose)).all()  # type: ignore[arg-type]
    pose.ClearField("euler")
    assert told(six, pose) is None
