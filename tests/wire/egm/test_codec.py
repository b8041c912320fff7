"""The bridge's side of EGM: packets, details, replies."""

from __future__ import annotations

import math
import re
import runpy
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from armlab.wire.egm import Beside, Codec, Details, Drop, EgmCodec, Packet, Reference
from armlab.wire.egm import armlab_egm_pb2 as pb
from armlab.wire.egm.axes import AxisMap
from armlab.wire.egm.robot_side import EXTENSION_ARRAYS, ROBOTWARE, RobotMessage, RobotSideCodec
from armlab.wire.egm.types import DROP_REASONS, StandingQueue
from tests.oracles.egm import decode_egm, encode_egm

from .conftest import arm

MOVES = {"position", "velocity", "external_axes", "rapid_data"}
TEN = [10.0, 20.0, 30.0, 40.0, 50.0, 60.0]


def accepted(found: Packet | Drop) -> Packet:
    assert isinstance(found, Packet), found
    return found


def alike(found: Packet | Drop, wanted: Packet | Drop) -> None:
    assert type(found) is type(wanted), (found, wanted)
    for x, y in zip(found, wanted, strict=True):
        np.testing.assert_array_equal(x, y, strict=isinstance(y, np.ndarray))
        assert type(x) is type(y) or x == y
        assert not isinstance(x, np.ndarray) or not x.flags.writeable


def as_protobuf(robot: Any, data: bytes) -> Packet | Drop:
    found = EgmCodec(robot).decode(data)
    alike(found, decode_egm(AxisMap(robot), data))
    return found


def message(robot: Any, k: int) -> RobotMessage:
    rows = np.random.default_rng(k).normal(size=(6, robot.n))
    fields: dict[str, Any] = {
        "T_frame_tool": np.eye(4), "wrench_raw": np.arange(6.0) + k, "rapid_data": (1.0 * k, 2.0),
        "rapid_digital": True, "tau_reference": rows[2], "qd": rows[3], "tau": rows[4], "robot_ns": 10**18 + k * 10**6,
        "mono_ns": 2**40 + k, "queue_depth": k, "utilization": 0.5 * k, "q_ext": (0.1 * k,), "motors": k % 3,
        "converged": k % 2 == 1,
    }  # fmt: skip
    return RobotMessage(300 + k, 70000 + k, rows[0], rows[1], **fields)


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


def test_the_reply_as_another_program_reads_it(yumi: Any, wire: Any) -> None:
    q = np.array([0.125, 0.25, 0.875, 0.375, 0.5, 0.625, 0.75]) * np.pi  # powers of two stay exact in degrees
    data = EgmCodec(yumi).encode(Reference(q, q / 2, None, 300, 7))
    degrees, speeds = q / (np.pi / 180), q / 2 / (np.pi / 180)
    six, seventh = degrees[[0, 1, 3, 4, 5, 6]], degrees[2]
    expected = (
        wire.header(300, 7, 3)
        + wire.m(2, wire.m(1, wire.d(1, *six)), wire.m(3, wire.d(1, seventh)))
        + wire.m(3, wire.m(1, wire.d(1, *speeds[[0, 1, 3, 4, 5, 6]])), wire.m(3, wire.d(1, speeds[2])))
    )
    assert data == expected


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
    """RobotWare 6.06 sends radians, later versions send degrees."""
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
    assert isinstance(codec.decode(wire.robot(wire.joints(1, 2, 3))), Drop)
    assert codec.robotware == "", "a dropped datagram decides nothing"
    old = wire.robot(wire.joints(*TEN))
    new = wire.header() + wire.m(2, wire.m(1, wire.joints(*TEN)), wire.m(4, wire.u(1, 9))) + wire.d(10, 5.0)
    assert accepted(codec.decode(old)).robotware == "6.06"
    assert accepted(codec.decode(new)).robotware == "6.06"
    codec.reset()
    assert accepted(codec.decode(new)).robotware == "6.10"
    assert accepted(codec.decode(old)).robotware == "6.10"


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
    codec: Codec = EgmCodec(six)
    assert codec.capabilities == MOVES
    assert EgmCodec(six, extension=True).capabilities == {*MOVES, "measured_torque", "torque"}
    assert EgmCodec(scara).capabilities == frozenset()
    assert EgmCodec(scara, extension=True).capabilities == {"measured_torque"}
    assert EgmCodec(scara, units=("deg",) * 4).capabilities == MOVES


def test_an_external_unit_alone(wire: Any) -> None:
    """See abb_libegm issues 57 and 107."""
    codec = EgmCodec(arm(np.zeros((0, 0))), units=("mm", "deg"))
    data = wire.header() + wire.m(2, wire.m(3, wire.d(1, 500.0, 90.0)), wire.m(4, wire.u(1, 1)))
    packet = accepted(codec.decode(data))
    assert packet.q.shape == (0,)
    np.testing.assert_allclose(packet.q_ext, [0.5, np.pi / 2])
    empty: Any = codec.decode(wire.header())
    assert empty.reason == "no joints"
    extra: Any = codec.decode(wire.robot(wire.joints(1.0)))
    assert extra.reason == "joint count"


@pytest.mark.parametrize("robotware", ROBOTWARE)
@pytest.mark.parametrize("extension", [False, ("qd", "tau")])
def test_packets_are_those_of_protobuf(six: Any, yumi: Any, scara: Any, robotware: str, extension: Any) -> None:
    for robot in (six, yumi, scara):
        side, codec = RobotSideCodec(robot, robotware, extension, force=True), EgmCodec(robot)
        for k in range(1, 12):
            data = side.encode_robot(message(robot, k))
            alike(codec.decode(data), decode_egm(AxisMap(robot), data))


def test_drops(six: Any, wire: Any) -> None:
    good = wire.joints(*TEN)
    for data, reason in (
        (b"", "no header"),
        (b"\x0a", "unparsable"),
        (b"\xff" * 40, "unparsable"),
        (wire.m(1, wire.u(3, 2)) + wire.m(2, wire.m(1, good)), "no header"),
        (wire.header(mtype=3) + wire.m(2, wire.m(1, good)), "wrong type"),
        (wire.header(mtype=2**64 - 1) + wire.m(2, wire.m(1, good)), "wrong type"),
        (wire.header(), "no joints"),
        (wire.header() + wire.m(2), "no joints"),
        (wire.robot(wire.joints(*TEN[:5])), "joint count"),
        (wire.robot(wire.joints(*TEN[:5], math.nan)), "not finite"),
        (wire.robot(wire.joints(*TEN[:5], -1e10)), "not finite"),
        (wire.robot(wire.joints(*TEN[:4], math.inf, -math.inf)), "not finite"),
        (wire.robot(good, external=wire.d(1, math.nan)), "not finite"),
        (wire.robot(good, external=wire.d(1, 1e200)), "not finite"),
        (wire.robot(good, wire.m(101, wire.packed(1, *TEN[:5], math.nan))), "not finite"),
        (wire.robot(good, wire.m(101, wire.packed(2, *TEN[:5]))), "joint count"),
        (wire.header() + wire.m(2, wire.m(1, wire.m(1, b"abc"))), "unparsable"),
    ):
        found = as_protobuf(six, data)
        assert isinstance(found, Drop), data
        assert found.reason == reason in DROP_REASONS, data


FORCE = struct.pack("<6d", *TEN)
TORN = b"\xff\xff\xff\xff\xff\xff\xff\x7f"  # a length
SIGNALLING = struct.unpack("<d", bytes.fromhex("010000000000f07f"))[0]  # NumPy warns of this NaN in a product


def unusual(wire: Any) -> list[bytes]:
    """Return messages with fields that a controller seldom or never sends."""
    pose = [wire.d(k + 1 if k < 3 else k - 2, x) for k, x in enumerate([1.0, 2.0, 3.0, 0.5, 0.5, 0.5, 0.5])]
    poses = [[*pose[:k], b"", *pose[k + 1 :]] for k in range(7)]
    forces = [b"", b"\x09", b"\xff\xff", b"\x09" + FORCE[:8], b"\x1a\x00", b"\x0a\x7f", b"\x1a" + TORN, b"\x08\x00"]
    forces += [b"\x0a\x30" + FORCE, b"\x12\x30" + FORCE, b"\x0a\x00\x22" + TORN, b"\x12\x30" + FORCE + b"\x08\x00"]
    more = [
        *(wire.m(9, force) for force in forces),
        *(wire.m(2, wire.m(2, wire.m(1, *one[:3]), wire.m(2, *one[3:]))) for one in poses),
        wire.m(2, wire.m(2, wire.m(1, *pose[:3]))) + wire.m(2, wire.m(2, wire.m(2, *pose[3:]), wire.m(3, b"\x09"))),
        wire.u(77, 5) + wire.m(99, b"?") + wire.d(10, 1.0),
        wire.m(10, b"abc") + wire.u(2, 1) + wire.d(1, 2.0) + wire.u(2**29 - 1, 5),
        wire.m(3, wire.m(1, wire.joints(*[SIGNALLING] * 6))),
        wire.m(4, wire.u(1, 2**64 - 1)) + wire.u(6, 7) + wire.m(8, wire.u(1, 2**31)) + wire.m(13, wire.d(2, 1.0, 2.0)),
        wire.m(2, wire.m(4, wire.u(1, 2**40), wire.u(2, 5))) + wire.m(2, wire.m(5, b"\x08")),
        wire.m(12, wire.m(2, b"123")) + wire.m(7, wire.packed(1, 1.0)),
        *(wire.m(101, wire.packed(field, *TEN[:5]), wire.u(14, 3)) for field in range(1, 8)),
        b"\x0b\x08\x01\x0c", b"\x0b\x0c\x0b", b"\x0b\x14", b"\x0c", b"\x0b" * 101, b"\x0b" * 99 + b"\x0c" * 99,
        b"\x00\x00", b"\x06", b"\x0d1234", b"\x0d123", b"\x80\x80\x80\x80\x80\x00\x00",
    ]  # fmt: skip
    return [wire.robot(wire.joints(*TEN), one) for one in more] + [
        wire.robot(wire.packed(1, *TEN), external=wire.d(1, 90.0, -90.0)),
        wire.robot(wire.joints(*TEN[:3])) + wire.m(2, wire.m(1, wire.joints(*TEN[3:]))),
        wire.header(2**35, 2**34, 2**32 + 2) + wire.m(2, wire.m(1, wire.joints(*TEN))),
    ]


def test_unusual_messages(six: Any, wire: Any) -> None:
    codec = EgmCodec(six)  # which keeps its state from one message to the next
    for data in unusual(wire):
        as_protobuf(six, data)
        codec.reset()
        alike(codec.decode(data), decode_egm(AxisMap(six), data))


@given(st.binary(max_size=400))
@settings(max_examples=100)
def test_any_bytes(yumi: Any, data: bytes) -> None:
    as_protobuf(yumi, data)
    assert EgmCodec(yumi).details(data) is None or data is not None


def test_every_truncation_and_a_large_datagram(yumi: Any) -> None:
    data = RobotSideCodec(yumi, "7", ("qd", "tau"), force=True).encode_robot(message(yumi, 1))
    for length in range(len(data)):
        as_protobuf(yumi, data[:length])
    as_protobuf(yumi, bytes(range(256)) * 255)


@given(st.data())
@settings(max_examples=150)
def test_mutated_messages(six: Any, wire: Any, data: st.DataObject) -> None:
    good = RobotSideCodec(six, "7", ("qd", "tau"), force=True).encode_robot(message(six, 1))
    mutated = bytearray(data.draw(st.sampled_from([good, *unusual(wire)])))
    for _ in range(data.draw(st.integers(1, 6))):
        where, size = data.draw(st.integers(0, len(mutated) - 1)), data.draw(st.integers(0, 9))
        keep = data.draw(st.booleans())
        mutated[where : where + size] = data.draw(st.binary(min_size=size if keep else 0, max_size=size))
    as_protobuf(six, bytes(mutated))
    codec = EgmCodec(six)
    accepted(codec.decode(good))
    codec.reset()
    alike(codec.decode(bytes(mutated)), decode_egm(AxisMap(six), bytes(mutated)))


def test_the_schema_is_that_of_the_kernel() -> None:
    root = Path(__file__).parents[3]
    kernel = (root / "native/wire/egm.cpp").read_text()
    named = dict(re.findall(r"namespace (Egm\w+) {\s*enum {(.*?)};\s*}", kernel, re.DOTALL))
    folder = root / "src/armlab/wire/egm"
    text = "".join((folder / f"{name}.py").read_text() for name in ("codec", "robot_side"))
    for kind in pb.DESCRIPTOR.message_types_by_name.values():
        if kind.name in named:
            fields = re.findall(r"(\w+) = (\d+)", named[kind.name])
            assert {name: int(number) for name, number in fields} == {f.name: f.number for f in kind.fields}, kind.name
        for field in kind.fields:
            assert not field.is_required
            assert kind.name in named or f".{field.name}" in text or f'"{field.name}"' in text, field.full_name
    assert {"EgmRobot", "EgmSensor", "EgmMotion", "EgmRIState", "EgmRIRef"} <= named.keys()
    assert (pb.DESCRIPTOR.name, pb.DESCRIPTOR.package) == ("armlab_egm.proto", "armlab.egm")  # not those of others
    runpy.run_path(pb.__file__)  # without a warning of an old generator


T = np.array([[0.0, 0, 1, 0.4], [1, 0, 0, -0.05], [0, 1, 0, 0.3], [0, 0, 0, 1]])


def test_a_pose_is_that_of_another_program(six: Any, vector: Any) -> None:
    twist = np.array([0.1, 0.2, 0.3, np.pi / 10, np.pi / 5, 0.3 * np.pi])
    ours, theirs = EgmCodec(six).encode_pose(T, twist, 3, 4), vector("sensor_pose")
    assert ours[:-56] == theirs[:-56]
    speeds = [np.frombuffer(data[-54:], dtype=[("tag", "u1"), ("value", "<f8")]) for data in (ours, theirs)]
    assert speeds[0]["tag"].tolist() == speeds[1]["tag"].tolist() == [9] * 6
    np.testing.assert_allclose(speeds[0]["value"], speeds[1]["value"], rtol=1e-14)
    message: Any = RobotSideCodec(six).decode_sensor(EgmCodec(six).encode_pose(T, twist, 2**32 + 5, 6))
    assert (message.seqno, message.tm_ms, message.mtype, message.q) == (5, 6, 3, None)
    np.testing.assert_allclose(message.T_frame_tool, T, atol=1e-15)
    np.testing.assert_allclose(message.twist, twist)


def test_a_path_correction_is_that_of_another_program(six: Any, wire: Any, vector: Any) -> None:
    theirs = wire.header(1, 0, 4)[2:]
    ours = EgmCodec(six).encode_path_correction((1.5e-3, -2e-3), 0.04, 1, 0)
    assert ours == wire.m(1, theirs) + vector("path_correction")[6:]
    message: Any = RobotSideCodec(six).decode_sensor(EgmCodec(six).encode_path_correction((1.5e-3, -2e-3), 0.04, 1, 9))
    np.testing.assert_allclose(message.path_yz, [1.5e-3, -2e-3])
    assert (message.path_age, message.tm_ms, message.mtype) == (0.04, 9, 4)


def test_everything_beside_the_joints_is_that_of_another_program(yumi: Any, wire: Any, vector: Any) -> None:
    """Fields as ABBRobotEGM writes them, plus `tm`."""
    q, qd = np.radians([10, 20, 70, 30, 40, 50, 60]), np.radians([1.0, 2, 7, 3, 4, 5, 6])
    beside = Beside(rapid_data=np.array([7.0, 8.0]), rapid_digital=True)
    ours = RobotSideCodec(yumi).decode_sensor(EgmCodec(yumi).encode(Reference(q, qd, None, 5, 0, beside=beside)))
    theirs = RobotSideCodec(yumi).decode_sensor(vector("sensor"))
    for a, b in zip(ours[2:], theirs[2:], strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-14) if isinstance(a, np.ndarray) else None
        assert isinstance(a, np.ndarray) or a == b


def test_axes_beyond_the_robot_byte_by_byte(yumi: Any, wire: Any) -> None:
    codec = EgmCodec(yumi, units=("deg",) * 7 + ("deg", "mm"))
    beside = Beside(np.array([np.pi / 2, 0.25]), np.array([0.0, 0.5]), np.array([2.5]), False)
    zeros = np.zeros(7)
    expected = (
        wire.header(1, 2, 3)
        + wire.m(2, wire.m(1, wire.d(1, *zeros[:6])), wire.m(3, wire.d(1, 0.0, 90.0, 250.0)))
        + wire.m(3, wire.m(1, wire.d(1, *zeros[:6])), wire.m(3, wire.d(1, 0.0, 0.0, 500.0)))
        + wire.m(4, wire.u(1, 0), wire.d(2, 2.5))
    )
    assert codec.encode(Reference(zeros, zeros, None, 1, 2, beside=beside)) == expected
    assert len(codec.encode(Reference(zeros, zeros, None, 1, 2))) < len(expected) - 20, "nothing is left over"


@given(st.data())
@settings(max_examples=40)
def test_replies_are_those_of_protobuf(six: Any, yumi: Any, scara: Any, data: st.DataObject) -> None:
    robot, extension = data.draw(st.sampled_from([six, yumi, scara, arm(np.zeros((0, 0)))])), data.draw(st.booleans())
    units = data.draw(st.sampled_from([(), ("deg",) * robot.n + ("mm",)]))
    codec = EgmCodec(robot, extension, units)
    integer = st.one_of(st.integers(0, 200), st.integers(0, 2**70))
    number, few = st.floats(-1e3, 1e3), st.integers(0, 3)
    array, short = arrays(np.float64, robot.n, elements=number), arrays(np.float64, few, elements=number)
    for _ in range(3):
        besides = st.builds(Beside, *[st.none() | short] * 3, st.none() | st.booleans())
        q, qd, tau = data.draw(array), data.draw(st.none() | array), data.draw(st.none() | array)
        counts, free = [data.draw(integer) for _ in range(4)], data.draw(st.booleans())
        ref = Reference(q, qd, tau, *counts, free, data.draw(st.none() | besides))
        assert codec.encode(ref) == encode_egm(AxisMap(robot, units), ref, extension)


def details_of(codec: EgmCodec, data: bytes) -> Details:
    details = codec.details(data)
    assert isinstance(details, Details)
    return details


def test_details_of_another_program(yumi: Any, vector: Any) -> None:
    """RobotWare 7 as ABBRobotEGM writes it."""
    codec = EgmCodec(yumi)
    codec.decode(vector("robot_rw7"))
    details = details_of(codec, vector("robot_rw7"))
    assert details.stamp_ns == 1_700_000_000_250_000_000 + 1
    assert (details.move_index, details.collision, details.force_control) == (4, False, True)
    np.testing.assert_allclose(details.collision_quota, [0.1] * 6)
    assert (details.planned_ns, details.planned_stamp_ns, details.mode, details.used_seq) == (None,) * 4
    assert details.q_ext_planned.size == details.test_signals.size == 0
    assert np.isnan([details.tau_total, details.current, details.q_reference]).all()
    assert np.isnan(details.T_frame_planned).all()


@pytest.mark.parametrize("order", [0, 1])
def test_every_field_of_the_extension(yumi: Any, wire: Any, order: int) -> None:
    abb = np.array([1.0, 2, 4, 5, 6, 7, 3])
    kinematic = np.array([1.0, 2, 3, 4, 5, 6, 7])
    values = kinematic if order else abb
    arrays = [wire.packed(field, *(10.0 * field + values)) for field in range(1, 8)]
    counts = [wire.u(9, 5), wire.u(10, 2), wire.u(11, 3), wire.u(12, order), wire.u(13, 77)]
    planned = [
        wire.m(2, wire.m(1, wire.d(1, 1000.0), wire.d(2, 0.0), wire.d(3, 0.0)), wire.m(2, wire.d(1, 1.0))),
        wire.m(3, wire.d(1, 0.0, 90.0)),
        wire.m(4, wire.u(1, 7), wire.u(2, 250_000)),
        wire.m(5, wire.u(1, 7), wire.u(2, 3)),
    ]
    data = wire.robot(
        wire.joints(*range(6)), wire.m(3, *planned), wire.m(7, wire.d(1, 0.5)), wire.m(101, *arrays, *counts),
        external=wire.joints(0.0, 0.0),
    )  # fmt: skip
    details = details_of(EgmCodec(yumi), data)
    np.testing.assert_allclose(details.tau_total, 30.0 + kinematic)
    np.testing.assert_allclose(details.tau_gravity, 40.0 + kinematic)
    np.testing.assert_allclose(details.current, 50.0 + kinematic)
    np.testing.assert_allclose(details.q_reference, np.radians(60.0 + kinematic))
    np.testing.assert_allclose(details.qd_reference, np.radians(70.0 + kinematic))
    assert (details.overruns, details.arm_id, details.mode, details.used_seq) == (5, 2, 3, 77)
    np.testing.assert_allclose(details.q_ext_planned, [np.pi / 2])
    assert (details.planned_ns, details.planned_stamp_ns) == (7_250_000_000, 7_000_000_003)
    assert details.T_frame_planned[0, 3] == 1.0
    assert details.test_signals.tolist() == [0.5]
    assert not details.tau_total.flags.writeable


def test_what_the_simulated_controller_says(yumi: Any) -> None:
    q = np.arange(7.0)
    arrays: Any = dict.fromkeys(EXTENSION_ARRAYS, q)
    codec = RobotSideCodec(yumi, "6.10", EXTENSION_ARRAYS)
    data = codec.encode_robot(RobotMessage(1, 2, q, q, mode=2, used_seq=9, overruns=1, **arrays))
    details = details_of(EgmCodec(yumi, extension=True), data)
    for name in EXTENSION_ARRAYS[2:]:
        np.testing.assert_allclose(getattr(details, name), q)
    assert (details.mode, details.used_seq, details.overruns) == (2, 9, 1)


def test_one_sentence_per_second_that_the_queue_is_never_empty() -> None:
    queue = StandingQueue()
    depths = [3] * 99 + [0] + [5, 2] * 100 + [-1] + [1] * 100
    sentences = {cycle: text for cycle, depth in enumerate(depths) if (text := queue.after(depth, 0.01))}
    assert list(sentences) == [199, 400]
    assert sentences[199].startswith("2 messages have waited"), "the fewest of that second"
    assert sentences[199].endswith("20 ms late.")
    assert sentences[400].startswith("1 message has waited")
