"""The content of packets: flavours, fields left out, force, torqueRef, external axes, time."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.errors import UnknownName
from armlab.sim.arm.arm import SimulatedArm
from armlab.sim.arm.truth import synthetic_truth
from armlab.sim.controller.guidance import Guidance
from armlab.sim.controller.packets import EPOCH_NS, OPTIONAL_FIELDS, Condition, PacketBuilder
from armlab.sim.controller.reference_decoder import ReferenceDecoder
from armlab.sim.controller.settings import ControllerSettings
from armlab.wire.egm import EgmCodec, Packet, RobotSideCodec, SensorMessage
from armlab.wire.egm import armlab_egm_pb2 as pb

ROBOT = robots.load("yumi_left")
ARM = SimulatedArm(ROBOT, synthetic_truth(ROBOT))
CONDITION = Condition(seq=5, motors=1, mci=3, rapid=2, converged=False, mode=1, used_seq=4, left=0)


def packet(robotware: str = "6.10", external: int = 0, **options: Any) -> bytes:
    codec = RobotSideCodec(ROBOT, robotware, force=options.get("force", False), external=external)
    guidance = Guidance(ROBOT, ControllerSettings(), ROBOT.q_home)
    packets = PacketBuilder(codec, 0.004032, **options)
    return packets.encode(250, ARM, guidance, CONDITION, [0.25] * external)


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


def test_unknown_fields_are_named() -> None:
    with pytest.raises(UnknownName, match="utilizationRate"):
        PacketBuilder(RobotSideCodec(ROBOT), 0.004, fields=["utilisation"])


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


def test_external_axes_follow_the_seventh() -> None:
    np.testing.assert_allclose(decode(packet(external=2)).q_ext, 0.25)


def test_rapid_sends_back_what_it_heard() -> None:
    target = ReferenceDecoder(ROBOT, ControllerSettings())
    target.accept(SensorMessage(0, 1, 3, rapid_data=np.arange(5.0), rapid_digital=True), ROBOT.q_home, None)
    condition = Condition(0, 1, 3, 2, False, 1, 0, 0)
    for data in (0, 3):
        packets = PacketBuilder(RobotSideCodec(ROBOT, "7"), 0.004, data=data)
        found = decode(
            packets.encode(0, ARM, Guidance(ROBOT, ControllerSettings(), ROBOT.q_home), condition, (), target)
        )
        assert (found.rapid_data.tolist(), found.rapid_digital) == ([0.0, 1.0, 2.0][:data], data > 0)


def test_time_is_exact_and_behind_by_the_phase() -> None:
    packets = PacketBuilder(RobotSideCodec(ROBOT), 0.00025, phase=0.0001)
    assert packets.time_ns(8) == EPOCH_NS + 2_100_000
    assert [packets.tm_ms(cycle) for cycle in range(9)] == [10_000] * 4 + [10_001] * 4 + [10_002]
