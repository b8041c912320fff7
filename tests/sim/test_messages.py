"""Messages of the simulated controller: packets, replies that wait, statistics, event log."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.sim.arm.arm import SimulatedArm
from armlab.sim.arm.truth import synthetic_truth
from armlab.sim.controller.controller import EPOCH_NS, OPTIONAL_FIELDS, PacketBuilder, ReplyQueue, Sent
from armlab.sim.controller.guidance import Guidance, ReferenceDecoder
from armlab.sim.controller.settings import ControllerSettings
from armlab.sim.controller.statistics import EventLog, Statistics
from armlab.wire.egm import Drop, EgmCodec, Packet, Reference
from armlab.wire.egm import armlab_egm_pb2 as pb
from armlab.wire.egm.robot_side import RobotSideCodec, SensorMessage

ROBOT = robots.load("yumi_left")
ARM = SimulatedArm(ROBOT, synthetic_truth(ROBOT))
CONDITION = {"seqno": 5, "motors": 1, "mci": 3, "rapid": 2, "converged": False}


def packet(robotware: str = "6.10", external: int = 0, **options: Any) -> bytes:
    codec = RobotSideCodec(ROBOT, robotware, force=options.get("force", False), external=external)
    guidance = Guidance(ROBOT, ControllerSettings(), ROBOT.q_home)
    packets = PacketBuilder(codec, 0.004032, **options)
    return packets.encode(250, ARM, guidance, [0.25] * external, **CONDITION)


def decode(data: bytes) -> Packet:
    found = EgmCodec(ROBOT).decode(data)
    assert isinstance(found, Packet)
    return found


@pytest.mark.parametrize("robotware", ["6.06", "6.07", "6.10", "7"])
def test_flavours_are_recognised_and_mean_the_same(robotware: str) -> None:
    found = decode(packet(robotware))
    assert found.robotware == robotware
    np.testing.assert_allclose(found.q, ROBOT.q_home, atol=2e-5)
    np.testing.assert_allclose(found.q_planned, ROBOT.q_home, atol=1e-12)


@pytest.mark.parametrize("field", OPTIONAL_FIELDS)
def test_each_field_can_be_left_out(field: str) -> None:
    def has(message: Any) -> bool:
        if field == "tm":
            return message.header.HasField("tm")
        return (message.feedBack if field in ("cartesian", "time") else message).HasField(field)

    assert has(pb.EgmRobot.FromString(packet()))
    without = packet(fields=[field])
    assert not has(pb.EgmRobot.FromString(without))
    decode(without)


@pytest.mark.parametrize("robotware", ["6.10", "7"])
def test_force_in_the_layout_of_the_robotware(robotware: str) -> None:
    ARM.step(ROBOT.q_home, np.zeros(7), np.arange(6.0))
    found = decode(packet(robotware, force=True))
    assert found.robotware == robotware
    np.testing.assert_allclose(found.wrench_raw, np.arange(6.0))
    assert np.isnan(decode(packet(robotware)).wrench_raw).all()


def test_torque_reference_of_robotware_7() -> None:
    message = pb.EgmRobot.FromString(packet("7", torque_reference=True))
    np.testing.assert_allclose(message.torqueRef.joints[:], ARM.sample.tau[[0, 1, 3, 4, 5, 6]])
    assert not pb.EgmRobot.FromString(packet("7")).HasField("torqueRef")


def test_rapid_sends_back_what_it_heard() -> None:
    target = ReferenceDecoder(ROBOT, ControllerSettings())
    target.accept(SensorMessage(0, 1, 3, rapid_data=np.arange(5.0), rapid_digital=True), ROBOT.q_home, None)
    for data in (0, 3):
        packets = PacketBuilder(RobotSideCodec(ROBOT, "7"), 0.004, data=data)
        guidance = Guidance(ROBOT, ControllerSettings(), ROBOT.q_home)
        found = decode(packets.encode(0, ARM, guidance, (), target, **CONDITION))
        assert (found.rapid_data.tolist(), found.rapid_digital) == ([0.0, 1.0, 2.0][:data], data > 0)


def test_time_is_exact_and_behind_by_the_phase() -> None:
    packets = PacketBuilder(RobotSideCodec(ROBOT), 0.00025, phase=0.0001)
    assert packets.time_ns(8) == EPOCH_NS + 2_100_000
    assert [packets.tm_ms(cycle) for cycle in range(9)] == [10_000] * 4 + [10_001] * 4 + [10_002]


RIGHT = robots.load("yumi_right")
LATE = 2.0  # s, after the first second


def inbox(**changes: Any) -> tuple[ReplyQueue, Statistics]:
    statistics = Statistics()
    box = ReplyQueue(RobotSideCodec(RIGHT), statistics, ControllerSettings(**changes))
    return box, statistics


def send(box: ReplyQueue, count: int, same_tm: int = 1) -> None:
    for k in range(count):
        box.note(Sent(k, 10_000 + 4 * (k // same_tm), 100 + k, True))
        box.stamp(10**9 + 4_000_000 * k, LATE)


def matched(box: ReplyQueue, message: SensorMessage, arrival_ns: int = 0) -> int | None:
    sent = box.match(message, arrival_ns, LATE)
    return sent and sent.seq


def test_the_echo_of_the_extension_decides() -> None:
    box, statistics = inbox()
    send(box, 5)
    assert matched(box, SensorMessage(7, 10_000, 3, echo_mono_ns=1, echo_seq=3), 10**9 + 12_100_000) == 3
    assert matched(box, SensorMessage(8, 10_000, 3, echo_mono_ns=1, echo_seq=99)) is None
    assert statistics.counts["matched by echo"] == 1
    assert statistics.as_dict()["round_trip_us"]["p50"] == pytest.approx(100.0)


def test_packets_of_one_millisecond_share_their_tm_and_are_told_apart() -> None:
    """With a period of 0.25 ms, each reply refers to the oldest unanswered packet with that tm."""
    box, _ = inbox(period=0.00025)
    send(box, 8, same_tm=4)
    assert [matched(box, SensorMessage(k, 10_000, 3)) for k in range(5)] == [0, 1, 2, 3, 3]
    assert matched(box, SensorMessage(9, 10_004, 3)) == 4


def test_a_packet_that_was_built_but_has_not_left_is_not_answered() -> None:
    """Replies are read just before the next packet leaves; the round trip is that of the one before."""
    box, statistics = inbox()
    send(box, 1)
    box.note(Sent(1, 10_004, 101, True))
    assert matched(box, SensorMessage(1, None, 3), 10**9 + 150_000) == 0
    assert statistics.as_dict()["round_trip_us"]["p50"] == pytest.approx(150.0)


@pytest.mark.parametrize("tm", [None, 0])
def test_by_order_where_nothing_is_echoed(tm: int | None) -> None:
    box, statistics = inbox()
    send(box, 3)  # the peer was not there for the first packets
    assert matched(box, SensorMessage(1, tm, 3)) == 2
    box.note(Sent(3, 10_012, 103, True))
    assert matched(box, SensorMessage(3, tm, 3)) == 3
    assert statistics.counts["matched by order"] == 2


def test_duplicates_count_and_do_not_measure() -> None:
    box, statistics = inbox()
    send(box, 2)
    for _ in range(3):
        assert matched(box, SensorMessage(5, 10_004, 3), 10**9 + 4_050_000) == 1
    assert statistics.counts["duplicates"] == 2
    assert statistics.counts["matched by tm"] == 1


def test_a_packet_without_a_reply_within_its_period_is_missed() -> None:
    box, statistics = inbox()
    for k in range(4):
        box.note(Sent(k, 10_000 + 4 * k, k, guiding=k != 2))
        box.stamp(10**9 + 4_000_000 * k, LATE)
        if k == 0:
            matched(box, SensorMessage(0, 10_000, 3), 10**9 + 200_000)
    assert statistics.counts["missed"] == 1, "packet 0 was answered, 2 did not guide, 3 has time left"


@pytest.mark.parametrize(("mode", "reason"), [("joint", None), ("pose", "no pose"), ("path", "no path correction")])
def test_messages_must_hold_what_the_mode_needs(mode: str, reason: str | None) -> None:
    box, statistics = inbox(mode=mode)
    found = box.read(EgmCodec(RIGHT).encode(Reference(np.zeros(7), None, None, 0, 0)))
    assert isinstance(found, Drop if reason else SensorMessage)
    assert reason is None or (isinstance(found, Drop) and found.reason == reason)
    assert dict(statistics.mtypes) == {3: 1}


def test_the_first_second_is_not_counted() -> None:
    statistics = Statistics()
    for uptime in (0.5, 0.999, 1.5, 2.5):
        statistics.miss(uptime)
        statistics.late(1e-3 * uptime, uptime)
        statistics.worked(1e-3 * uptime, 1, uptime)
        statistics.trip(1e-6 * uptime, uptime)
    data = statistics.as_dict()
    assert data["counts"] == {"missed": 2, "overruns": 2}
    assert (data["wake_up_late_us"]["max"], data["work_us"]["max"]) == pytest.approx((2500.0, 2500.0))
    assert (data["round_trip_us"]["p50"], data["round_trip_us"]["max"]) == pytest.approx((2.0, 2.5))
    assert data["round_trip_us"]["first"] == pytest.approx(0.5), "the only time that includes the first second"


def test_everything_is_plain_json_and_text() -> None:
    statistics = Statistics()
    statistics.counts["packets"] += 3
    statistics.drops["unparsable"] += 1
    statistics.queue[1] += 2
    statistics.age[1] += 2
    statistics.late(1e-4, uptime=2.0)
    statistics.record_reply(np.array([7.0, 8.5]), True, np.array([0.5]))
    statistics.record_reply(None, None, None)
    journal = EventLog("yumi_left", statistics, None)
    for _ in range(2):  # sessions: each reports a kind of drop once
        for _ in range(3):
            journal.drop(0.5, Drop("no header", "4 bytes"), b"\1\2")
        journal.begin()
    data = json.loads(json.dumps(statistics.as_dict()))
    assert data["counts"] == {"RAPID data": 1, "RAPID digital": 1, "external axes": 1, "packets": 3}
    assert (data["rapid"], data["external_axes"]) == ({"1": 7.0, "2": 8.5, "digital": 1.0}, {"1": 0.5})
    assert data["drops"] == {"no header": 6, "unparsable": 1}
    assert data["queue_depth"] == {"1": 2}
    assert data["reference_age"] == {"1": 2, "last": 0}
    assert data["wake_up_late_us"]["p50"] == pytest.approx(100.0)
    assert data["round_trip_us"] == {}
    event = {"t": 0.5, "task": "yumi_left", "number": 0}
    event["text"] = "dropped a datagram, no header: 4 bytes; first bytes 01 02"
    assert data["events"] == [event, event]
    assert "dropped: 6 no header, 1 unparsable" in statistics.line()
    assert "round trip" not in statistics.line()
    assert "nothing" in statistics.text()
