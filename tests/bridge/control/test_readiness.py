"""Whether a robot would follow."""

from __future__ import annotations

from typing import Any

import pytest

from armlab.bridge.control.feedback import MCI_RUNNING, Readiness, obstacle
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
        ({"motors": 0}, "no state of the motors"),
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


def test_one_or_two_packets_without_a_state_end_no_motion(packets: Any) -> None:
    readiness = Readiness()
    for fields in ({}, {"motors": None}, {"mci": None}, {}, {"motors": None, "mci": None}, {"motors": None}):
        assert readiness.obstacle(packet(packets, **fields)) == ""
    assert "motors" in readiness.obstacle(packet(packets, motors=None))
    assert readiness.obstacle(packet(packets)) == ""
    assert "motors are off" in readiness.obstacle(packet(packets, motors=2))
    readiness.begin()
    assert "motors" in readiness.obstacle(packet(packets, motors=None)), "of a new session nothing is known"
