"""What came to a port, judged."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.bridge.doctor.egm_listener import Heard
from armlab.bridge.doctor.findings import Finding
from armlab.bridge.net.sockets import Arrival
from armlab.robots import Robot
from armlab.wire.egm import RobotMessage, RobotSideCodec

PERIOD_NS = 4_032_000
SOURCE = ("192.0.2.7", 40_000)


class Line:
    """Packets of a robot at the times of the test."""

    def __init__(self, robot: Robot, heard: Heard, robotware: Any = "6.10") -> None:
        self.robot, self.heard = robot, heard
        self.codec = RobotSideCodec(robot, robotware=robotware)
        self.now = 10**9

    def __call__(self, seqno: int, source: tuple[str, int] = SOURCE, after: int = PERIOD_NS, **fields: Any) -> None:
        self.now += after
        q = fields.pop("q", self.robot.q_home)
        values = {"motors": 1, "mci": 3, "rapid": 2, "robot_ns": 10**18 + self.now, **fields}
        message = RobotMessage(seqno=seqno, tm_ms=self.now // 10**6, q=q, q_planned=q, **values)
        self.heard.add(Arrival(self.codec.encode_robot(message), source, self.now))


def judged(heard: Heard) -> dict[str, Finding]:
    return {finding.name.partition(", ")[2]: finding for finding in heard.findings(1.0)}


@pytest.fixture
def heard(robot: Robot) -> Heard:
    return Heard(6510, robot)


@pytest.fixture
def line(robot: Robot, heard: Heard) -> Line:
    return Line(robot, heard)


def test_a_robot_that_is_ready(heard: Heard, line: Line, monkeypatch: pytest.MonkeyPatch) -> None:
    for k in range(100):
        line(k)
    monkeypatch.setattr("armlab.bridge.doctor.egm_listener.time.monotonic_ns", lambda: line.now)
    found = judged(heard)
    assert {finding.verdict for finding in found.values()} == {"ok"}
    assert "100.0/s from 192.0.2.7:40000" in found["packets"].value
    assert "period 4.032 ms" in found["timing"].value
    assert "RobotWare 6.10, 7 axes" in found["first packet"].value
    assert found["guidance"].value == "ready for references"
    assert found["sessions"].value == "1"
    assert "robot minus computer" in found["clock"].value
    assert "absent" in found["extension"].value


def test_silence(heard: Heard) -> None:
    (finding,) = heard.findings(5.0)
    assert (finding.verdict, finding.value) == ("warning", "none in 5 s")
    for word in ("UDPUC", "EGMRunJoint", "ufw allow 6510/udp"):
        assert word in finding.advice


def test_two_senders(heard: Heard, line: Line) -> None:
    for k in range(10):
        line(k)
        line(k + 70, source=("192.0.2.8", 50_000))
    found = judged(heard)["senders"]
    assert (found.verdict, found.value) == ("failure", "2")
    assert "port of its own" in found.advice


@pytest.mark.parametrize("data", [b"", b"hello", b"\xff" * 40])
def test_something_else(heard: Heard, data: bytes) -> None:
    heard.add(Arrival(data, SOURCE, 1))
    found = judged(heard)["first packet"]
    assert found.verdict == "failure"
    assert "no packet of a robot: 1 " in found.value


def test_wrong_axes(heard: Heard) -> None:
    Line(robots.load("irb120"), heard)(0)
    found = judged(heard)["first packet"]
    assert found.verdict == "failure"
    assert "wrong axes: 1 joint count" in found.value
    assert "not a yumi_right, which has 7 axes" in found.advice


@pytest.mark.parametrize(("name", "words"), [("irb120", "6 axes"), ("yumi_left", "6 axes and 1 external, a YuMi's")])
def test_any_robot(name: str, words: str) -> None:
    heard = Heard(6510)
    Line(robots.load(name), heard)(0)
    found = judged(heard)
    assert words in found["first packet"].value
    assert found["posture"].verdict == "ok"


@pytest.mark.parametrize(("robotware", "advice"), [("6.06", "radians"), ("6.07", "6.07.01")])
def test_old_robotware(robot: Robot, heard: Heard, robotware: str, advice: str) -> None:
    Line(robot, heard, robotware)(0)
    found = judged(heard)["first packet"]
    assert found.verdict == "warning"
    assert f"RobotWare {robotware}" in found.value
    assert advice in found.advice


def test_a_posture_that_cannot_be(robot: Robot, heard: Heard, line: Line) -> None:
    line(0, q=robot.q_max + 1.0)
    found = judged(heard)["posture"]
    assert found.verdict == "failure"
    assert "Usual causes" in found.advice


@pytest.mark.parametrize(
    ("fields", "words", "advice"),
    [
        ({"motors": 2}, "the motors are off", "enabling device"),
        ({"rapid": 1}, "RAPID is stopped", "from main"),
        ({"mci": 2}, "guidance has not begun", "EGMRunJoint"),
    ],
)
def test_not_ready(heard: Heard, line: Line, fields: dict[str, Any], words: str, advice: str) -> None:
    line(0, **fields)
    found = judged(heard)["guidance"]
    assert found.verdict == "warning"
    assert words in found.value
    assert advice in found.advice


def test_lost_and_repeated_packets(heard: Heard, line: Line) -> None:
    for k in (0, 1, 1, 4, 5):
        line(k)
    found = judged(heard)["timing"]
    assert found.verdict == "warning"
    assert "2 lost, 1 repeated" in found.value


def test_an_uneven_network(heard: Heard, line: Line) -> None:
    for k in range(50):
        line(k, after=PERIOD_NS + (3_000_000 if k % 10 == 9 else 0))
    assert judged(heard)["timing"].verdict == "warning"


def test_why_a_session_ended(heard: Heard, line: Line) -> None:
    line(0)
    line(1, motors=2)
    line(0, after=10**9)
    found = judged(heard)["sessions"]
    assert found.verdict == "warning"
    assert "the controller stopped sending" in found.value or "motors were switched off" in found.value


def test_the_extension(robot: Robot, heard: Heard) -> None:
    line = Line(robot, heard)
    line.codec = RobotSideCodec(robot, extension=True)
    line(0, qd=np.zeros(7), tau=np.zeros(7))
    assert "present" in judged(heard)["extension"].value
