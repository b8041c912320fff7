"""The network, and what comes to a port while nothing is sent to a robot."""

from __future__ import annotations

import os
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.bridge.doctor import network
from armlab.bridge.doctor.egm_listener import Heard
from armlab.bridge.doctor.findings import Finding
from armlab.bridge.doctor.network import addresses, firewall, listen, local_addresses, route_to
from armlab.bridge.net.sockets import Arrival
from armlab.robots import Robot
from armlab.wire.egm.robot_side import RobotMessage, RobotSideCodec


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("0.0.0.0", 0))
        return one.getsockname()[1]


@contextmanager
def streaming(peer: Any) -> Iterator[None]:
    """Let a peer send at 500 Hz while the block runs."""
    over = threading.Event()

    def play() -> None:
        while not over.wait(0.002):
            peer.send()

    thread = threading.Thread(target=play, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join(10)


def named(findings: list[Finding]) -> dict[str, Finding]:
    return {finding.name: finding for finding in findings}


def test_own_addresses() -> None:
    found = local_addresses()
    assert found["lo"] == "127.0.0.1"
    assert addresses({"lo": "127.0.0.1", "eth0": "192.0.2.1"}).verdict == "ok"
    assert "eth0 192.0.2.1" in addresses({"lo": "127.0.0.1", "eth0": "192.0.2.1"}).value
    alone = addresses({"lo": "127.0.0.1"})
    assert alone.verdict == "warning"
    assert "cable" in alone.advice
    assert addresses({}).value == "none"


def test_route() -> None:
    assert route_to("127.0.0.1") == "127.0.0.1"
    assert route_to("no such host") == ""


def test_firewall(tmp_path: Path) -> None:
    file = tmp_path / "ufw.conf"
    assert firewall(file).verdict == "ok"
    file.write_text("# comment\nENABLED=no\n", encoding="utf-8")
    assert firewall(file).verdict == "ok"
    file.write_text("ENABLED=yes\n", encoding="utf-8")
    assert firewall(file).verdict == "warning"
    assert "ufw allow" in firewall(file).advice


def test_a_port_that_another_holds() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("0.0.0.0", 0))
        number = other.getsockname()[1]
        (found,) = listen([number], 0.01, [None], asked=True)
    assert (found.name, found.verdict) == (f"port {number}", "failure")
    assert f"process {os.getpid()}" in found.advice


def test_silence_is_told_once_when_nobody_asked() -> None:
    one, two = free_port(), free_port()
    found = named(listen([one, two], 0.01, [None, None], asked=False))
    assert found[f"port {one}"].verdict == "ok"
    assert found[f"port {one}, self-test"].verdict == "ok"
    assert found[f"port {one}, packets"].verdict == "warning"
    assert f"port {two}, packets" not in found
    found = named(listen([one, two], 0.01, [None, None], asked=True))
    assert found[f"port {two}, packets"].verdict == "warning"


def test_a_robot_is_heard_and_gets_nothing(robot: Robot, make_peer: Any) -> None:
    number = free_port()
    peer = make_peer(robot, number)
    with streaming(peer):
        found = named(listen([number], 0.25, [robot], asked=True))
    assert peer.surplus() == 0
    assert "7 axes" in found[f"port {number}, first packet"].value
    assert "leave from 127.0.0.1" in found[f"port {number}, route"].value
    assert found[f"port {number}, senders"].verdict == "ok"
    assert f"from 127.0.0.1:{peer.socket.getsockname()[1]}" in found[f"port {number}, packets"].value


def test_two_robots_on_one_port(robot: Robot, make_peer: Any) -> None:
    number = free_port()
    first, second = make_peer(robot, number), make_peer(robot, number)
    with streaming(first), streaming(second):
        found = named(listen([number], 0.25, [robot], asked=True))
    assert found[f"port {number}, senders"].verdict == "failure"
    assert first.surplus() == second.surplus() == 0


def test_no_route_to_a_robot(robot: Robot, make_peer: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(network, "route_to", lambda host: "")
    number = free_port()
    peer = make_peer(robot, number)
    with streaming(peer):
        found = named(listen([number], 0.25, [robot], asked=True))
    assert found[f"port {number}, route"].verdict == "failure"
    assert "network of 127.0.0.1" in found[f"port {number}, route"].advice


def test_a_rule_that_drops_packets(monkeypatch: pytest.MonkeyPatch) -> None:
    """As a firewall does: an address of this computer from which nothing arrives."""
    monkeypatch.setattr(network, "local_addresses", lambda: {"eth9": "203.0.113.9"})
    number = free_port()
    found = named(listen([number], 0.01, [None], asked=True))[f"port {number}, self-test"]
    assert found.verdict == "failure"
    assert "203.0.113.9" in found.advice


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
