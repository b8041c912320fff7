"""The invented SCARA robot: its slide travels in the robot's joints, in metres times 180 / pi."""

from __future__ import annotations

import numpy as np

from armlab.sim.arm.arm import scara
from armlab.wire.egm import EgmCodec, Packet, RobotMessage, RobotSideCodec
from armlab.wire.egm import armlab_egm_pb2 as pb


def test_the_slide_goes_down() -> None:
    robot = scara()
    T_base_tool = robot.chain.forward(robot.q_home)
    lower = robot.chain.forward(robot.q_home + np.array([0.0, 0.0, 0.05, 0.0]))
    np.testing.assert_allclose(lower[:3, 3] - T_base_tool[:3, 3], [0.0, 0.0, -0.05], atol=1e-12)


def test_its_packets() -> None:
    robot, q = scara(), np.array([0.1, 0.2, 0.09, 0.3])
    data = RobotSideCodec(robot).encode_robot(RobotMessage(0, 1, q))
    joints = pb.EgmRobot.FromString(data).feedBack.joints.joints[:]
    np.testing.assert_allclose(joints, np.degrees(q))
    packet = EgmCodec(robot).decode(data)
    assert isinstance(packet, Packet)
    np.testing.assert_allclose(packet.q, q)
