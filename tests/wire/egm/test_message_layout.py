"""Layouts that are learnt from one message and used for the next ones."""

from __future__ import annotations

import itertools
import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armlab.wire.egm import Drop, EgmCodec, Packet, RobotMessage, RobotSideCodec
from armlab.wire.egm.axes import AxisMap, Refused
from armlab.wire.egm.message_layout import INTEGERS, Numbers, Places, Shape, find_places

SEVEN = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]


def message(arm: Any, k: int, **more: Any) -> RobotMessage:
    rng = np.random.default_rng(k)
    rows = rng.normal(size=(6, arm.n))
    fields: dict[str, Any] = {
        "T_frame_tool": np.eye(4), "wrench_raw": np.arange(6.0) + k, "rapid_data": (1.0 * k, 2.0),
        "rapid_digital": True, "tau_reference": rows[2], "qd": rows[3], "tau": rows[4], "robot_ns": 10**18 + k * 10**6,
        "mono_ns": 2**40 + k, "queue_depth": k, "utilization": 0.5 * k, "q_ext": (0.1 * k,),
    }  # fmt: skip
    return RobotMessage(300 + k, 70000 + k, rows[0], rows[1], **(fields | more))


def alike(a: Packet | Drop, b: Packet | Drop) -> None:
    assert type(a) is type(b)
    for x, y in zip(a, b, strict=True):
        np.testing.assert_array_equal(x, y, strict=isinstance(y, np.ndarray))


def parsed(codec: EgmCodec, arm: Any, data: bytes) -> Packet | Drop:
    """What a codec that has learnt nothing but the flavour says."""
    fresh = EgmCodec(arm)
    fresh.robotware = codec.robotware
    return fresh.decode(data)


@pytest.mark.parametrize("robotware", ["6.06", "6.07", "6.10", "7"])
@pytest.mark.parametrize("extension", [False, ("qd", "tau")])
@pytest.mark.parametrize("axes", ["six", "yumi", "scara"])
def test_packets_read_as_parsed(request: Any, axes: str, robotware: str, extension: Any) -> None:
    arm = request.getfixturevalue(axes)
    robot, codec = RobotSideCodec(arm, robotware, extension, force=True), EgmCodec(arm)
    for k in range(1, 60):
        data = robot.encode_robot(message(arm, k))
        alike(codec.decode(data), parsed(codec, arm, data))
    assert codec._known  # learnt, not parsed each time


def test_the_second_packet_is_not_parsed(yumi: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    robot, codec = RobotSideCodec(yumi, "7", force=True), EgmCodec(yumi)
    codec.decode(robot.encode_robot(message(yumi, 1)))
    monkeypatch.setattr(EgmCodec, "_parsed", None)
    assert isinstance(codec.decode(robot.encode_robot(message(yumi, 2))), Packet)


def test_a_state_that_changes_is_seen(yumi: Any) -> None:
    robot, codec = RobotSideCodec(yumi, "7"), EgmCodec(yumi)
    for k, (mci, converged) in enumerate([(3, False), (2, False), (3, True), (3, False)]):
        packet: Any = codec.decode(robot.encode_robot(message(yumi, k, mci=mci, converged=converged)))
        assert (packet.mci, packet.converged) == (mci, converged)


def test_what_is_no_position_is_dropped_by_a_layout_too(six: Any) -> None:
    robot, codec = RobotSideCodec(six), EgmCodec(six)
    good = message(six, 1)
    assert isinstance(codec.decode(robot.encode_robot(good)), Packet)
    for name, value in itertools.product(("q", "q_ext"), (np.nan, 1e200)):
        bad = robot.encode_robot(good._replace(**{name: np.full(len(getattr(good, name)), value)}))
        found: Any = codec.decode(bad)
        assert (type(found), found.reason) == (Drop, "not finite")


def test_a_robot_that_never_looks_alike_is_parsed(six: Any, wire: Any) -> None:
    codec = EgmCodec(six)
    for k in range(1100):
        data = wire.robot(wire.joints(*range(6)), wire.m(4, wire.u(1, k)))
        packet: Any = codec.decode(data)
        assert packet.motors == k
    assert codec._learnt == 1100


@given(st.data())
@settings(max_examples=300)
def test_mutations_of_what_was_learnt(yumi: Any, data: st.DataObject) -> None:
    """Same length or not, tags, lengths, states or numbers hit: reading and parsing agree."""
    robot, codec = RobotSideCodec(yumi, "7", ("qd", "tau"), force=True), EgmCodec(yumi)
    good = robot.encode_robot(message(yumi, 1))
    codec.decode(good)
    mutated = bytearray(good)
    for _ in range(data.draw(st.integers(1, 4))):
        where, size = data.draw(st.integers(0, len(mutated) - 1)), data.draw(st.integers(0, 9))
        keep = data.draw(st.booleans())
        mutated[where : where + size] = data.draw(st.binary(min_size=size if keep else 0, max_size=size))
    alike(codec.decode(bytes(mutated)), parsed(codec, yumi, bytes(mutated)))


@pytest.mark.parametrize("tag", [b"\x1a", b"\x0a\x00\x22"])
def test_lengths_beyond_a_force_allocate_nothing(six: Any, wire: Any, tag: bytes) -> None:
    """measuredForce is bytes for a parser: what a length inside it says, nobody has checked."""
    length = b"\xff\xff\xff\xff\xff\xff\xff\x7f"
    data = wire.robot(wire.joints(*range(6)), wire.m(9, tag, length))
    assert find_places(data) is None
    assert isinstance(EgmCodec(six).decode(data), Packet)


def test_a_number_in_bytes_that_are_none_is_not_learnt(six: Any, wire: Any) -> None:
    """A parser takes it for a field that it does not know; its place lies beyond the datagram."""
    codec, data = EgmCodec(six), wire.robot(wire.joints(*range(6)), wire.m(10, b"abc"))
    alike(codec.decode(data), parsed(codec, six, data))
    assert isinstance(codec.decode(data), Packet)


@pytest.mark.parametrize("missing", range(7))
def test_a_pose_that_lacks_a_number_reads_as_parsed(six: Any, wire: Any, missing: int) -> None:
    """Learnt from a packet whose quaternion is unusable, so that its pose is NaN wherever its numbers lie."""
    codec = EgmCodec(six)
    for first in (np.nan, 1.0):
        numbers = [1.0, 2.0, 3.0, first, first, first, first]
        parts = [wire.d(k + 1 if k < 3 else k - 2, x) for k, x in enumerate(numbers)]
        parts[missing] = b""
        pose = wire.m(2, wire.m(1, *parts[:3]), wire.m(2, *parts[3:]))
        data = wire.header(5, 7) + wire.m(2, wire.m(1, wire.joints(*range(6))), pose)
        alike(codec.decode(data), parsed(codec, six, data))


def test_places(wire: Any) -> None:
    data = wire.header(300, 5) + wire.m(2, wire.m(1, wire.d(1, 1.0, 2.0))) + wire.u(6, 1)
    places = find_places(data)
    assert isinstance(places, Places)
    assert places.integers["header.seqno"] == (3, 5)
    first, second = places.doubles["feedBack.joints.joints"]
    assert second - first == 9
    assert places.mask[first : first + 8] == bytes(8)
    assert places.mask[3:5] == b"\x80\x80"  # varies
    assert places.mask[-1] == 0xFF  # a state


@pytest.mark.parametrize(
    "data", [b"\x0a", b"\x0a\xff", b"\x0b", b"\x09\x01", b"\x0a\x01\x08", bytes(2049), b"\x12\x04\x0a\x02\x09\x09"]
)
def test_no_places_in_what_is_no_message(data: bytes) -> None:
    found = find_places(data)
    assert found is None or not found.doubles


RADIAN = np.pi / 180


def numbers(**more: Any) -> Numbers:
    found: dict[str, Any] = dict.fromkeys(Numbers._fields, ())
    return Numbers(**(found | more))


def shape(axes: AxisMap, of: Numbers, robotware: str = "7", has_research: bool = False) -> Shape:
    return Shape(
        axes, of, False, has_tm=True, has_research=has_research, states=(1, 3, 2), converged=False,
        robotware=robotware, rapid_digital=False,
    )  # fmt: skip


def test_order_and_units_by_hand(yumi: Any) -> None:
    of = numbers(
        joints=(10.0, 20.0, 30.0, 40.0, 50.0, 60.0),
        external=(70.0, 100.0),
        torque_reference=(1.0, 2.0, 3.0, 4.0, 5.0, 6.0),
        utilization=(12.5,),
        pose=(100.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0),
    )
    form = shape(AxisMap(yumi, ("deg",) * 7 + ("mm",)), of)
    packet: Any = form.reader.packet(form.arranged(of, 0.0), (5, 6, 1, 250000, 0, 0))
    np.testing.assert_allclose(packet.q, np.radians([10, 20, 70, 30, 40, 50, 60]))
    np.testing.assert_array_equal(packet.tau, [1, 2, np.nan, 3, 4, 5, 6])
    np.testing.assert_allclose(packet.q_ext, [0.1])
    assert (packet.utilization, packet.robot_ns, packet.T_frame_tool[0, 3]) == (12.5, 1_250_000_000, 0.1)
    assert (packet.qd, packet.queue_depth) == (None, -1)


def test_old_versions_are_in_radians(six: Any) -> None:
    of = numbers(joints=(1.0,) * 6, external=(2.0,))
    form = shape(AxisMap(six), of, "6.06")
    packet: Any = form.reader.packet(form.arranged(of, 0.0), (0,) * len(INTEGERS))
    np.testing.assert_array_equal(packet.q, np.ones(6))
    np.testing.assert_array_equal(packet.q_ext, [2.0])


def test_offsets_are_arranged_as_values_are(yumi: Any) -> None:
    offsets = {"feedBack.joints.joints": list(range(6)), "feedBack.externalJoints.joints": [6], "utilizationRate": [9]}
    of = Numbers.of_offsets(offsets)
    arranged = shape(AxisMap(yumi), of).arranged(of, -1)
    assert arranged[:7] == [0, 1, 6, 2, 3, 4, 5]
    assert arranged[-8:] == [9] + [-1] * 7


def test_what_is_not_finite_gives_no_packet(six: Any) -> None:
    of = numbers(joints=(1.0,) * 5 + (np.inf,))
    form = shape(AxisMap(six), of)
    assert form.reader.packet(form.arranged(of, 0.0), (0,) * 6) is None


def test_wrong_counts(six: Any) -> None:
    with pytest.raises(Refused):
        shape(AxisMap(six), numbers(joints=(1.0,) * 5))


def test_a_signalling_nan_does_not_warn(six: Any) -> None:
    """NumPy warns of one in a product; in a loop whose warnings are errors that would be an exception."""
    signalling = struct.unpack("<d", bytes.fromhex("010000000000f07f"))[0]
    of = numbers(joints=(1.0,) * 6, planned=(signalling,) * 6)
    form = shape(AxisMap(six), of)
    packet: Any = form.reader.packet(form.arranged(of, 0.0), (0,) * 6)
    assert np.isnan(packet.q_planned).all()
