"""Whether a robot would follow."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from armlab.bridge.readiness import MCI_RUNNING, implausible, obstacle
from armlab.robots import Robot
from armlab.wire.egm import EgmCodec, Packet


def packet(packets: Any, **fields: Any) -> Packet:
    found = EgmCodec(packets.robot).decode(packets(**fields))
    assert isinstance(found, Packet)
    return found


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({}, ""),
        ({"rapid": 0}, ""),
        ({"rapid": None}, ""),
        ({"motors": 2}, "motors are off"),
        ({"motors": 0}, "motors are off"),
        ({"rapid": 1}, "RAPID is stopped"),
        ({"mci": 2}, "EGMRunJoint"),
        ({"mci": 1}, "EGMRunJoint"),
    ],
)
def test_obstacles(packets: Any, fields: dict[str, int], words: str) -> None:
    one = packet(packets, **fields)
    found = obstacle(one.motors, one.rapid, one.mci)
    assert words in found
    assert bool(found) == bool(words)
    assert packet(packets).mci == MCI_RUNNING


def test_feedback_outside_the_limits(robot: Robot) -> None:
    q = np.array(robot.q_max)
    assert implausible(q + 0.09, robot) == ""
    q[4] += 0.2
    sentence = implausible(q, robot)
    assert f"joint 5 ({robot.joint_names[4]})" in sentence
    assert f"{q[4]:.3f}" in sentence
    assert "units" in sentence
