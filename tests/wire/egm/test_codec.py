"""The bridge's side of EGM: decoding and replies."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from armlab.wire.egm import Beside, Drop, EgmCodec, Packet, Reference, RobotMessage, RobotSideCodec
from armlab.wire.egm.axes import AxisMap
from armlab.wire.egm.codec import Replies, encode_path_correction, encode_pose
from armlab.wire.egm.types import DROP_REASONS

RADIAN = math.pi / 180
MOVES = {"position", "velocity", "external_axes", "rapid_data"}
TEN = [10.0, 20.0, 30.0, 40.0, 50.0, 60.0]


def accepted(found: Packet | Drop) -> Packet:
    assert isinstance(found, Packet), found
    return found


def test_a_message_of_another_program(yumi: Any, vector: Callable[[str], bytes]) -> None:
    packet = accepted(EgmCodec(yumi).decode(vector("robot_rw7")))
    assert (packet.seqno, packet.tm_ms, packet.robot_ns) == (300, 123456, 1_700_000_000_250_000_000)
    np.testing.assert_allclose(packet.q, np.radians([10, 20, 70, 30, 40, 50, 60]), rtol=1e-15)
    np.testing.assert_allclose(packet.q_planned, np.radians([11, 21, 71, 31, 41, 51, 61]), rtol=1e-15)
    np.testing.assert_allclose(packet.T_frame_tool[:3, 3], [0.4, -0.05, 0.3])
    np.testing.assert_allclose(packet.T_frame_tool[:3, :3], [[0, 0, 1], [1, 0, 0], [0, 1, 0]], atol=1e-15)
    np.testing.assert_array_equal(packet.wrench_raw, [1, 2, 3, 0.1, 0.2, 0.3])
    np.testing.assert_array_equal(packet.tau, [1, 2, np.nan, 3, 4, 5, 6])
    assert (packet.tau_source, packet.robotware, packet.utilization) == ("reference", "7", 12.5)
    assert (packet.motors, packet.mci, packet.rapid, packet.converged) == (1, 3, 2, False)
    assert packet.rapid_data.tolist() == [7, 8]
    assert packet.rapid_digital is True
    assert packet.qd is None
    assert packet.q_ext.size == 0
    assert not packet.q.flags.writeable


def test_the_reply_as_another_program_reads_it(yumi: Any, wire: Any) -> None:
    """Field by field in the order of the wire: header, planned, speedRef; doubles unpacked, axis 7 external."""
    q = np.array([0.125, 0.25, 0.875, 0.375, 0.5, 0.625, 0.75]) * 180 * RADIAN  # powers of two stay exact in degrees
    data = EgmCodec(yumi).encode(Reference(q, q / 2, None, 300, 7))
    degrees = q / RADIAN
    six, seventh = degrees[[0, 1, 3, 4, 5, 6]], degrees[2]
    expected = (
        wire.header(300, 7, 3)
        + wire.m(2, wire.m(1, wire.d(1, *six)), wire.m(3, wire.d(1, seventh)))
        + wire.m(3, wire.m(1, wire.d(1, *(q / 2 / RADIAN)[[0, 1, 3, 4, 5, 6]])), wire.m(3, wire.d(1, degrees[2] / 2)))
    )
    assert data == expected


def test_replies_do_not_remember_each_other(six: Any, wire: Any) -> None:
    codec = EgmCodec(six, extension=True)
    q = np.arange(6.0)
    first = codec.encode(Reference(q, q, q, 1, 1, 2, 3))
    assert codec.encode(Reference(-q, -q, None, 2, 1, 2, 3)) != first
    assert codec.encode(Reference(q, q, q, 1, 1, 2, 3)) == first
    assert len(codec.encode(Reference(q, None, None, 1, 1))) < len(first)


@pytest.mark.parametrize(
    ("more", "flavour"),
    [
        ((), "6.06"),
        (("time",), "6.07"),
        (("time", "utilization"), "6.10"),
        (("time", "utilization", "move"), "7"),
        (("time", "utilization", "rapid"), "7"),
        (("time", "utilization", "collision"), "7"),
        (("time", "utilization", "torque"), "7"),
        (("time", "utilization", "force7"), "7"),
        (("time", "utilization", "force6"), "6.10"),
        (("time", "stamp"), "7"),
    ],
)
def test_flavours(six: Any, wire: Any, more: tuple[str, ...], flavour: str) -> None:
    """Radians and degrees: the same number on the wire is 57 times larger on RobotWare 6.06."""
    motion = [wire.m(1, wire.joints(*TEN))]
    motion += [wire.m(4, wire.u(1, 1), wire.u(2, 5))] if "time" in more else []
    motion += [wire.m(5, wire.u(1, 1))] if "stamp" in more else []
    fields = {
        "utilization": wire.d(10, 5.0),
        "move": wire.u(11, 1),
        "collision": wire.m(12),
        "rapid": wire.m(13, wire.u(1, 1)),
        "torque": wire.m(14, wire.d(1, *TEN)),
        "force6": wire.m(9, wire.d(1, *TEN)),
        "force7": wire.m(9, wire.u(1, 0), wire.d(2, *TEN)),
    }
    data = wire.header() + wire.m(2, *motion) + b"".join(fields[name] for name in more if name in fields)
    packet = accepted(EgmCodec(six).decode(data))
    assert packet.robotware == flavour
    np.testing.assert_allclose(packet.q, TEN if flavour == "6.06" else np.radians(TEN))


def test_the_flavour_is_kept_for_the_session(six: Any, wire: Any) -> None:
    codec = EgmCodec(six)
    old = wire.robot(wire.joints(*TEN))
    new = wire.header() + wire.m(2, wire.m(1, wire.joints(*TEN)), wire.m(4, wire.u(1, 9))) + wire.d(10, 5.0)
    assert accepted(codec.decode(old)).robotware == "6.06"
    assert accepted(codec.decode(new)).robotware == "6.06"
    codec.reset()
    assert accepted(codec.decode(new)).robotware == "6.10"
    assert accepted(codec.decode(old)).robotware == "6.10"


def test_a_dropped_datagram_decides_no_flavour(six: Any, wire: Any) -> None:
    codec = EgmCodec(six)
    assert isinstance(codec.decode(wire.robot(wire.joints(1, 2, 3))), Drop)
    assert codec.robotware == ""


def test_packed_doubles_unknown_fields_and_external_axes(six: Any, wire: Any) -> None:
    data = wire.robot(wire.packed(1, *TEN), wire.u(77, 5), wire.m(99, b"?"), external=wire.d(1, 90.0, -90.0))
    packet = accepted(EgmCodec(six).decode(data + wire.d(10, 1.0)))
    np.testing.assert_allclose(packet.q, np.radians(TEN))
    np.testing.assert_allclose(packet.q_ext, np.radians([90, -90]))


def test_what_is_absent_is_nan_not_zero(six: Any, wire: Any) -> None:
    packet = accepted(
        EgmCodec(six).decode(wire.m(1, wire.u(1, 3), wire.u(3, 2)) + wire.m(2, wire.m(1, wire.joints(*TEN))))
    )
    assert packet.tm_ms is None
    assert (packet.robot_ns, packet.motors, packet.mci, packet.rapid, packet.queue_depth) == (0, 0, 0, 0, -1)
    assert (packet.qd, packet.tau, packet.tau_source) == (None, None, "none")
    for values in (packet.q_planned, packet.T_frame_tool, packet.wrench_raw, packet.utilization):
        assert np.isnan(values).all()


@pytest.mark.parametrize("order", [0, 1])
def test_extension_in_both_orders(yumi: Any, wire: Any, order: int) -> None:
    values = [1.0, 2, 3, 4, 5, 6, 7]
    state = wire.m(
        101, wire.packed(1, *values), wire.packed(2, *values), wire.u(8, 2**63), wire.u(12, order), wire.u(14, 3)
    )
    data = wire.robot(wire.joints(*TEN), state, external=wire.d(1, 70.0))
    packet = accepted(EgmCodec(yumi).decode(data))
    expected = values if order == 1 else [1, 2, 7, 3, 4, 5, 6]
    np.testing.assert_allclose(packet.qd, np.radians(expected))
    np.testing.assert_array_equal(packet.tau, expected)
    assert (packet.tau_source, packet.robot_mono_ns, packet.queue_depth) == ("measured", 2**63, 3)


def test_extension_reply_echoes(yumi: Any) -> None:
    q = np.linspace(-1, 1, 7)
    reply = EgmCodec(yumi, extension=True).encode(Reference(q, q, 2 * q, 5, 6, 300, 2**64 - 1))
    message: Any = RobotSideCodec(yumi).decode_sensor(reply)
    assert (message.seqno, message.tm_ms, message.echo_seq, message.echo_mono_ns) == (5, 6, 300, 2**64 - 1)
    np.testing.assert_allclose(message.tau, 2 * q)
    assert message.q_reference is None


def test_capabilities(six: Any, scara: Any) -> None:
    assert EgmCodec(six).capabilities == MOVES
    assert EgmCodec(six, extension=True).capabilities == {*MOVES, "measured_torque", "torque"}
    assert EgmCodec(scara).capabilities == frozenset()
    assert EgmCodec(scara, extension=True).capabilities == {"measured_torque"}
    assert EgmCodec(scara, units=("deg",) * 4).capabilities == MOVES


def test_an_external_unit_alone(wire: Any) -> None:
    """Its own task and channel: no joints, no pose, external joints only (abb_libegm issues 57 and 107)."""
    arm = SimpleNamespace(n=0, prismatic=np.zeros(0, bool), abb_axes=(), coupling=np.zeros((0, 0)))
    codec = EgmCodec(arm, units=("mm", "deg"))
    data = wire.header() + wire.m(2, wire.m(3, wire.d(1, 500.0, 90.0)), wire.m(4, wire.u(1, 1)))
    for _ in range(2):
        packet = accepted(codec.decode(data))
        assert packet.q.shape == (0,)
        np.testing.assert_allclose(packet.q_ext, [0.5, np.pi / 2])
    empty: Any = codec.decode(wire.header())
    assert empty.reason == "no joints"
    extra: Any = codec.decode(wire.robot(wire.joints(1.0)))
    assert extra.reason == "joint count"


def drops(wire: Any) -> dict[str, tuple[bytes, str]]:
    good = wire.joints(*TEN)
    return {
        "empty": (b"", "no header"),
        "one byte": (b"\x0a", "unparsable"),
        "huge varint": (b"\xff" * 40, "unparsable"),
        "no seqno": (wire.m(1, wire.u(3, 2)) + wire.m(2, wire.m(1, good)), "no header"),
        "sensor": (wire.header(mtype=3) + wire.m(2, wire.m(1, good)), "wrong type"),
        "unknown type": (wire.header(mtype=2**64 - 1) + wire.m(2, wire.m(1, good)), "wrong type"),
        "no feedback": (wire.header(), "no joints"),
        "no joints": (wire.header() + wire.m(2), "no joints"),
        "five joints": (wire.robot(wire.joints(*TEN[:5])), "joint count"),
        "NaN": (wire.robot(wire.joints(*TEN[:5], math.nan)), "not finite"),
        "infinity": (wire.robot(wire.joints(*TEN[:5], math.inf)), "not finite"),
        "too large": (wire.robot(wire.joints(*TEN[:5], -1e10)), "not finite"),
        "both infinities": (wire.robot(wire.joints(*TEN[:4], math.inf, -math.inf)), "not finite"),
        "external NaN": (wire.robot(good, external=wire.d(1, math.nan)), "not finite"),
        "extension NaN": (wire.robot(good, wire.m(101, wire.packed(1, *TEN[:5], math.nan))), "not finite"),
        "extension count": (wire.robot(good, wire.m(101, wire.packed(2, *TEN[:5]))), "joint count"),
        "joints are text": (wire.header() + wire.m(2, wire.m(1, wire.m(1, b"abc"))), "unparsable"),
    }


@pytest.mark.parametrize(
    "kind",
    [
        *("empty", "one byte", "huge varint", "no seqno", "sensor", "unknown type", "no feedback", "no joints"),
        *("five joints", "NaN", "infinity", "too large", "both infinities", "external NaN", "extension NaN"),
        *("extension count", "joints are text"),
    ],
)
def test_drops_by_kind(six: Any, wire: Any, kind: str) -> None:
    data, reason = drops(wire)[kind]
    found = EgmCodec(six).decode(data)
    assert isinstance(found, Drop)
    assert found.reason == reason
    assert reason in DROP_REASONS


def check_any(arm: Any, data: bytes) -> None:
    found = EgmCodec(arm).decode(data)
    if isinstance(found, Drop):
        assert found.reason in DROP_REASONS
    else:
        assert np.isfinite(found.q).all()
        assert found.q.shape == (arm.n,)
        assert abs(found.robot_ns) < 2**63
        assert found.qd is None or np.isfinite(found.qd).all()


@given(st.binary(max_size=400))
@settings(max_examples=300)
def test_any_bytes(yumi: Any, data: bytes) -> None:
    check_any(yumi, data)


def full_message(arm: Any) -> bytes:
    one = np.ones(arm.n)
    message = RobotMessage(
        1, 2, one, one, 10**18, (1.0,), np.eye(4), wrench_raw=np.ones(6), rapid_data=(1.0,), rapid_digital=True,
        tau_reference=one, qd=one, tau=one, tau_total=one, tau_gravity=one,
    )  # fmt: skip
    return RobotSideCodec(arm, "7", extension=("qd", "tau")).encode_robot(message)


def test_every_truncation(yumi: Any) -> None:
    data = full_message(yumi)
    for length in range(len(data)):
        check_any(yumi, data[:length])


@given(st.data())
@settings(max_examples=300)
def test_mutated_messages(yumi: Any, data: st.DataObject) -> None:
    message = bytearray(full_message(yumi))
    for _ in range(data.draw(st.integers(1, 8))):
        where = data.draw(st.integers(0, len(message) - 1))
        message[where : where + data.draw(st.integers(0, 3))] = data.draw(st.binary(max_size=4))
    check_any(yumi, bytes(message))


def test_a_large_datagram(six: Any) -> None:
    check_any(six, bytes(range(256)) * 255)


def test_the_schema_lives_beside_others() -> None:
    """Our names are ours; egm.proto and abb.egm belong to other packages of the same process."""
    from armlab.wire.egm import armlab_egm_pb2 as pb

    assert pb.DESCRIPTOR.name == "armlab_egm.proto"
    assert pb.DESCRIPTOR.package == "armlab.egm"
    labels = [f.is_required for m in pb.DESCRIPTOR.message_types_by_name.values() for f in m.fields]
    assert not any(labels)


def test_the_generated_module_loads_without_a_warning() -> None:
    code = "import armlab.wire.egm"
    subprocess.run([sys.executable, "-W", "error", "-c", code], check=True)


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
