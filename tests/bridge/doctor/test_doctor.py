"""Checks of `armlab doctor`: computer and network on their good and bad side, and what comes to a port."""

from __future__ import annotations

import importlib.metadata
import os
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest

from armlab import robots
from armlab.bridge.doctor import report
from armlab.bridge.doctor.egm_listener import EgmListener
from armlab.bridge.doctor.machine import (
    Finding,
    Verdict,
    blas,
    clock,
    garbage,
    governor,
    machine,
    other_programs,
    packages,
    python,
    real_time,
    ros_nodes,
    ros_on_path,
    throttle,
    wake_up,
)
from armlab.bridge.doctor.report import (
    DEFAULT_PORTS,
    LONGEST,
    addresses,
    examine,
    firewall,
    listen,
    route_to,
)
from armlab.bridge.net.sockets import Arrival, local_addresses
from armlab.errors import ConfigError
from armlab.robots import Robot
from armlab.wire.egm.robot_side import RobotMessage, RobotSideCodec


def test_all_checks_of_this_computer_say_something() -> None:
    found = machine(0.02)
    assert len({finding.name for finding in found}) == len(found) == 12
    assert all(finding.value for finding in found)
    assert all(finding.advice for finding in found if finding.verdict != "ok")


def test_python() -> None:
    assert python().verdict == "ok"
    assert python((3, 10, 4)).verdict == "failure"
    assert "3.10.4" in python((3, 10, 4)).value


def test_packages() -> None:
    assert packages().verdict == "ok"
    assert "numpy" in packages().value

    def without_zstandard(name: str) -> str:
        if name in ("zstandard", "viser"):
            raise importlib.metadata.PackageNotFoundError(name)
        return "1.0"

    found = packages(without_zstandard)
    assert (found.verdict, found.value, found.advice) == ("failure", "missing: zstandard", "pip install zstandard")


def test_packages_that_do_not_go_together() -> None:
    found = packages(lambda name: "15.1" if name == "rich" else "1.0")
    assert found.verdict == "warning"
    assert "rich<15" in found.advice
    assert packages(lambda name: "14.9").verdict == "ok"


@pytest.mark.parametrize(
    ("environment", "path", "where"),
    [
        ({"PYTHONPATH": "/opt/ros/humble/lib/python3.10/site-packages"}, [], "PYTHONPATH"),
        ({"LD_LIBRARY_PATH": "/lib:/opt/ros/humble/lib"}, [], "LD_LIBRARY_PATH"),
        ({}, ["/opt/ros/noetic/lib/python3/dist-packages"], "sys.path"),
    ],
)
def test_ros_on_the_path(environment: dict[str, str], path: list[str], where: str) -> None:
    found = ros_on_path(environment, path)
    assert found.verdict == "warning"
    assert where in found.value
    assert "setup.bash" in found.advice


def test_no_ros_on_the_path() -> None:
    assert ros_on_path({"PYTHONPATH": "/home"}, ["/usr/lib"]).verdict == "ok"


def test_settings_of_nodes_that_would_look_for_the_bridge() -> None:
    assert ros_nodes({}).value.startswith("domain 0, nodes: no settings; bridge: 127.0.0.1")
    told = {"ROS_DOMAIN_ID": "7", "RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"}
    found = ros_nodes(told)
    assert found.value.startswith("domain 7, nodes: RMW_IMPLEMENTATION=rmw_cyclonedds_cpp;")
    assert found.verdict == "warning"
    assert "ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST" in found.advice
    for more in ({"CYCLONEDDS_URI": "<CycloneDDS/>"}, {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}):
        assert ros_nodes({**told, **more}).verdict == "ok"
    assert ros_nodes({"RMW_IMPLEMENTATION": "rmw_fastrtps_cpp"}).verdict == "ok"


def test_clock() -> None:
    assert clock(1e-9).verdict == "ok"
    assert clock(4e-3).verdict == "warning"


def test_real_time_priority(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*arguments: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    asked: list[int] = []
    monkeypatch.setattr(os, "sched_setscheduler", lambda pid, policy, parameters: asked.append(policy))
    assert real_time().verdict == "ok"
    assert len(asked) == 2
    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    found = real_time()
    assert found.verdict == "warning"
    assert "rtprio" in found.advice


@pytest.mark.parametrize(
    ("text", "verdict", "value"),
    [("950000\n", "ok", "95 %"), ("-1", "ok", "off"), ("0", "warning", "0 %"), ("?", "ok", "not told")],
)
def test_throttle(tmp_path: Path, text: str, verdict: str, value: str) -> None:
    file = tmp_path / "runtime"
    file.write_text(text, encoding="utf-8")
    assert throttle(file).verdict == verdict
    assert value in throttle(file).value
    assert throttle(tmp_path / "none").verdict == "ok"


def test_governor(tmp_path: Path) -> None:
    assert governor(tmp_path).verdict == "ok"
    for number, kind in enumerate(("performance", "powersave")):
        folder = tmp_path / f"cpu{number}" / "cpufreq"
        folder.mkdir(parents=True)
        (folder / "scaling_governor").write_text(f"{kind}\n", encoding="utf-8")
        assert governor(tmp_path).verdict == ("ok" if number == 0 else "warning")
    assert governor(tmp_path).value == "performance, powersave"


def test_wake_up() -> None:
    """On a clock of the test: one sleeper is 0.1 ms late, the other 3 ms."""
    for late, verdict in ((1e-4, "ok"), (3e-3, "warning")):
        time = [100.0]

        def sleep(seconds: float, time: list[float] = time, late: float = late) -> None:
            time[0] += seconds + late

        found = wake_up(0.2, sleep, lambda time=time: time[0])
        assert found.verdict == verdict
        assert f"{1e6 * late:.0f} us (p99)" in found.value
    assert wake_up(0.0).value == "not measured"


def test_garbage(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "objects" in garbage(lambda: None).value
    assert garbage(lambda: None).verdict == "ok"
    times = iter([0.0, 0.2])
    monkeypatch.setattr("armlab.bridge.doctor.machine.time.perf_counter", lambda: next(times))
    found = garbage(lambda: None)
    assert found.verdict == "warning"
    assert "200.0 ms" in found.value


def test_what_is_only_told() -> None:
    assert blas().verdict == other_programs().verdict == "ok"
    assert "no Chromium" in other_programs(lambda name: None).value
    assert other_programs(lambda name: "/usr/bin/" + name).value.startswith("chromium,")


def test_every_question_is_answered() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("0.0.0.0", 0))
        number = one.getsockname()[1]
    found = examine([number], 0.05, wake_up=0.02)
    names = [finding.name for finding in found]
    assert len(set(names)) == len(names)
    for name in ("Python", "ROS", "wake-up", "addresses", "firewall", f"port {number}"):
        assert name in names
    assert names[-1] == f"port {number}, packets"
    assert DEFAULT_PORTS == (6510, 6511, 6512)


@pytest.mark.parametrize("ports", [[], [70_000], [-1], [6510, 6510]])
def test_ports_that_cannot_be(ports: list[int]) -> None:
    with pytest.raises(ConfigError, match="different UDP ports"):
        examine(ports, 0.1)


@pytest.mark.parametrize("seconds", [0.0, -1.0, float("nan"), float("inf"), LONGEST + 1.0])
def test_seconds_that_cannot_be(seconds: float) -> None:
    with pytest.raises(ConfigError, match="Expected seconds"):
        examine([6510], seconds)


def test_robots_and_ports(robot: Robot) -> None:
    with pytest.raises(ConfigError, match="got 1 robots and 2 ports"):
        examine([6511, 6512], 0.1, [robot])


def test_advice_belongs_to_what_is_wrong() -> None:
    assert Finding.judged("a", "failure", True, "v", "do") == Finding("a", "failure", "v", "do")
    assert Finding.judged("a", "failure", False, "v", "do") == Finding("a", "ok", "v", "")
    assert get_args(Verdict) == ("ok", "warning", "failure")


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
        found = named(listen([number], 0.1, [robot], asked=True))
    assert peer.surplus() == 0
    assert "7 axes" in found[f"port {number}, first packet"].value
    assert "leave from 127.0.0.1" in found[f"port {number}, route"].value
    assert found[f"port {number}, senders"].verdict == "ok"
    assert f"from 127.0.0.1:{peer.socket.getsockname()[1]}" in found[f"port {number}, packets"].value


def test_two_robots_on_one_port(robot: Robot, make_peer: Any) -> None:
    number = free_port()
    first, second = make_peer(robot, number), make_peer(robot, number)
    with streaming(first), streaming(second):
        found = named(listen([number], 0.1, [robot], asked=True))
    assert found[f"port {number}, senders"].verdict == "failure"
    assert first.surplus() == second.surplus() == 0


def test_no_route_to_a_robot(robot: Robot, make_peer: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report, "route_to", lambda host: "")
    number = free_port()
    peer = make_peer(robot, number)
    with streaming(peer):
        found = named(listen([number], 0.1, [robot], asked=True))
    assert found[f"port {number}, route"].verdict == "failure"
    assert "network of 127.0.0.1" in found[f"port {number}, route"].advice


def test_a_rule_that_drops_packets(monkeypatch: pytest.MonkeyPatch) -> None:
    """As a firewall does: an address of this computer from which nothing arrives."""
    monkeypatch.setattr(report, "local_addresses", lambda: {"eth9": "203.0.113.9"})
    number = free_port()
    found = named(listen([number], 0.01, [None], asked=True))[f"port {number}, self-test"]
    assert found.verdict == "failure"
    assert "203.0.113.9" in found.advice


PERIOD_NS = 4_032_000
SOURCE = ("192.0.2.7", 40_000)
RIGHT = robots.load("yumi_right")


class Line:
    """Packets of a robot at the times of the test."""

    def __init__(self, robot: Robot, heard: EgmListener, robotware: Any = "6.10") -> None:
        self.robot, self.heard = robot, heard
        self.codec = RobotSideCodec(robot, robotware=robotware)
        self.now = 10**9

    def __call__(self, seqno: int, source: tuple[str, int] = SOURCE, after: int = PERIOD_NS, **fields: Any) -> None:
        self.now += after
        q = fields.pop("q", self.robot.q_home)
        values = {"motors": 1, "mci": 3, "rapid": 2, "robot_ns": 10**18 + self.now, **fields}
        message = RobotMessage(seqno=seqno, tm_ms=self.now // 10**6, q=q, q_planned=q, **values)
        self.heard.add(Arrival(self.codec.encode_robot(message), source, self.now))


def judged(heard: EgmListener) -> dict[str, Finding]:
    return {finding.name.partition(", ")[2]: finding for finding in heard.findings(1.0)}


@pytest.fixture
def heard(robot: Robot) -> EgmListener:
    return EgmListener(6510, robot)


@pytest.fixture
def line(robot: Robot, heard: EgmListener) -> Line:
    return Line(robot, heard)


def test_a_robot_that_is_ready(heard: EgmListener, line: Line, monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_silence(heard: EgmListener) -> None:
    (finding,) = heard.findings(5.0)
    assert (finding.verdict, finding.value) == ("warning", "none in 5 s")
    for word in ("UDPUC", "EGMRunJoint", "ufw allow 6510/udp"):
        assert word in finding.advice


@pytest.mark.parametrize("data", [b"", b"hello", b"\xff" * 40])
def test_something_else(heard: EgmListener, data: bytes) -> None:
    heard.add(Arrival(data, SOURCE, 1))
    found = judged(heard)["first packet"]
    assert found.verdict == "failure"
    assert "no packet of a robot: 1 " in found.value


def test_wrong_axes(heard: EgmListener) -> None:
    Line(robots.load("irb120"), heard)(0)
    found = judged(heard)["first packet"]
    assert found.verdict == "failure"
    assert "wrong axes: 1 joint count" in found.value
    assert "not a yumi_right, which has 7 axes" in found.advice


@pytest.mark.parametrize(("name", "words"), [("irb120", "6 axes"), ("yumi_left", "6 axes and 1 external, a YuMi's")])
def test_any_robot(name: str, words: str) -> None:
    heard = EgmListener(6510)
    Line(robots.load(name), heard)(0)
    found = judged(heard)
    assert words in found["first packet"].value
    assert found["posture"].verdict == "ok"


@pytest.mark.parametrize(("robotware", "advice"), [("6.06", "radians"), ("6.07", "6.07.01")])
def test_old_robotware(robot: Robot, heard: EgmListener, robotware: str, advice: str) -> None:
    Line(robot, heard, robotware)(0)
    found = judged(heard)["first packet"]
    assert found.verdict == "warning"
    assert f"RobotWare {robotware}" in found.value
    assert advice in found.advice


def test_the_extension(robot: Robot, heard: EgmListener) -> None:
    line = Line(robot, heard)
    line.codec = RobotSideCodec(robot, extension=True)
    line(0, qd=np.zeros(7), tau=np.zeros(7))
    assert "present" in judged(heard)["extension"].value


OTHER = ("192.0.2.8", 50_000)
UNEVEN = [{"seqno": k, "after": PERIOD_NS + 3_000_000 * (k % 10 == 9)} for k in range(50)]
ENDED = [{"seqno": 0}, {"seqno": 1, "motors": 2}, {"seqno": 0, "after": 10**9}]


@pytest.mark.parametrize(
    ("packets", "name", "verdict", "value", "advice"),
    [
        ([{"seqno": 0}, {"seqno": 70, "source": OTHER}], "senders", "failure", "2", "port of its own"),
        ([{"seqno": 0, "q": RIGHT.q_max + 1.0}], "posture", "failure", "q = ", "Usual causes"),
        ([{"seqno": 0, "motors": 2}], "guidance", "warning", "the motors are off", "enabling device"),
        ([{"seqno": 0, "rapid": 1}], "guidance", "warning", "RAPID is stopped", "from main"),
        ([{"seqno": 0, "mci": 2}], "guidance", "warning", "guidance has not begun", "EGMRunJoint"),
        ([{"seqno": k} for k in (0, 1, 1, 4, 5)], "timing", "warning", "2 lost, 1 repeated", "cable"),
        (UNEVEN, "timing", "warning", "0 lost, 0 repeated", "cable"),
        (ENDED, "sessions", "warning", "2, last end: the", "CommTimeout"),
    ],
)
def test_what_packets_tell(
    heard: EgmListener, line: Line, packets: Any, name: str, verdict: str, value: str, advice: str
) -> None:
    for packet in packets:
        line(**packet)
    found = judged(heard)[name]
    assert found.verdict == verdict
    assert value in found.value
    assert advice in found.advice
