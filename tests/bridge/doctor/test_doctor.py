"""Checks of `armlab doctor`: passing and failing checks of computer and network, and packets at a port."""

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
    EgmListener,
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


def versions(missing: str = "", **newer: str) -> Any:
    def version(name: str) -> str:
        if name in missing.split():
            raise importlib.metadata.PackageNotFoundError(name)
        return newer.get(name, "1.0")

    return version


ROS = "/opt/ros/humble/lib/python3.10/site-packages"
NODES = {"ROS_DOMAIN_ID": "7", "RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"}
LOOP = {"lo": "127.0.0.1"}


@pytest.mark.parametrize(
    ("found", "verdict", "value", "advice"),
    [
        (python(), "ok", "", ""),
        (python((3, 10, 4)), "failure", "3.10.4", "3.11 or newer"),
        (packages(), "ok", "numpy", ""),
        (packages(versions("zstandard viser")), "failure", "missing: zstandard", "pip install zstandard"),
        (packages(versions(rich="15.1")), "warning", "rich 15.1", "rich<15"),
        (packages(versions(rich="14.9")), "ok", "rich 14.9", ""),
        (ros_on_path({"PYTHONPATH": ROS}, []), "warning", "PYTHONPATH", "setup.bash"),
        (ros_on_path({"LD_LIBRARY_PATH": f"/lib:{ROS}"}, []), "warning", "LD_LIBRARY_PATH", "setup.bash"),
        (ros_on_path({}, [ROS]), "warning", "sys.path", "setup.bash"),
        (ros_on_path({"PYTHONPATH": "/home"}, ["/usr/lib"]), "ok", "not on the path", ""),
        (ros_nodes({}), "ok", "domain 0, nodes: no settings; bridge: 127.0.0.1", ""),
        (ros_nodes(NODES), "warning", "domain 7, nodes: RMW_IMPLEMENTATION=rmw_cyclonedds_cpp;", "RANGE=LOCALHOST"),
        (ros_nodes({**NODES, "CYCLONEDDS_URI": "<CycloneDDS/>"}), "ok", "<CycloneDDS/>", ""),
        (ros_nodes({**NODES, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}), "ok", "LOCALHOST", ""),
        (ros_nodes({"RMW_IMPLEMENTATION": "rmw_fastrtps_cpp"}), "ok", "rmw_fastrtps_cpp", ""),
        (clock(1e-9), "ok", "1 ns", ""),
        (clock(4e-3), "warning", "4000000 ns", "high-resolution"),
        (blas(), "ok", "", ""),
        (other_programs(lambda name: None), "ok", "no Chromium", ""),
        (other_programs(lambda name: "/usr/bin/" + name), "ok", "chromium,", ""),
        (addresses({**LOOP, "eth0": "192.0.2.1"}), "ok", "eth0 192.0.2.1", ""),
        (addresses(LOOP), "warning", "", "cable"),
        (addresses({}), "warning", "none", "cable"),
        (Finding.judged("a", "failure", True, "v", "do"), "failure", "v", "do"),
        (Finding.judged("a", "failure", False, "v", "do"), "ok", "v", ""),
    ],
)
def test_verdicts(found: Finding, verdict: str, value: str, advice: str) -> None:
    assert found.verdict == verdict
    assert value in found.value
    assert advice in found.advice
    assert bool(found.advice) == bool(advice)
    assert get_args(Verdict) == ("ok", "warning", "failure")


@pytest.mark.parametrize(
    ("check", "text", "verdict", "value"),
    [
        (throttle, "950000\n", "ok", "95 %"),
        (throttle, "-1", "ok", "off"),
        (throttle, "0", "warning", "0 %"),
        (throttle, "?", "ok", "not reported"),
        (throttle, None, "ok", ""),
        (firewall, None, "ok", ""),
        (firewall, "# comment\nENABLED=no\n", "ok", ""),
        (firewall, "ENABLED=yes\n", "warning", ""),
    ],
)
def test_settings_in_files(tmp_path: Path, check: Any, text: str | None, verdict: str, value: str) -> None:
    file = tmp_path / "setting"
    if text is not None:
        file.write_text(text, encoding="utf-8")
    found = check(file)
    assert found.verdict == verdict
    assert value in found.value
    assert check is throttle or ("ufw allow" in found.advice) == (verdict == "warning")


def test_governor(tmp_path: Path) -> None:
    assert governor(tmp_path).verdict == "ok"
    for number, kind in enumerate(("performance", "powersave")):
        folder = tmp_path / f"cpu{number}" / "cpufreq"
        folder.mkdir(parents=True)
        (folder / "scaling_governor").write_text(f"{kind}\n", encoding="utf-8")
        assert governor(tmp_path).verdict == ("ok" if number == 0 else "warning")
    assert governor(tmp_path).value == "performance, powersave"


@pytest.mark.parametrize(("error", "verdict"), [(None, "ok"), (PermissionError(1, "not permitted"), "warning")])
def test_real_time_priority(monkeypatch: pytest.MonkeyPatch, error: Exception | None, verdict: str) -> None:
    asked: list[int] = []

    def schedule(pid: int, policy: int, parameters: Any) -> None:
        asked.append(policy)
        if error is not None:
            raise error

    monkeypatch.setattr(os, "sched_setscheduler", schedule)
    found = real_time()
    assert (found.verdict, len(asked)) == (verdict, 2 if error is None else 1)
    assert ("rtprio" in found.advice) == (verdict == "warning")


def test_wake_up() -> None:
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


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("0.0.0.0", 0))
        return one.getsockname()[1]


def test_every_question_is_answered() -> None:
    number = free_port()
    names = [finding.name for finding in examine([number], 0.05, wake_up=0.02)]
    assert len(set(names)) == len(names)
    for name in ("Python", "ROS", "wake-up", "addresses", "firewall", f"port {number}"):
        assert name in names
    assert names[-1] == f"port {number}, packets"
    assert DEFAULT_PORTS == (6510, 6511, 6512)
    assert local_addresses()["lo"] == route_to("127.0.0.1") == "127.0.0.1"
    assert route_to("no such host") == ""


@pytest.mark.parametrize(
    ("ports", "seconds", "arms", "words"),
    [
        ([], 0.1, None, "different UDP ports"),
        ([70_000], 0.1, None, "different UDP ports"),
        ([-1], 0.1, None, "different UDP ports"),
        ([6510, 6510], 0.1, None, "different UDP ports"),
        *(([6510], seconds, None, "Expected seconds") for seconds in (0.0, -1.0, np.nan, np.inf, LONGEST + 1.0)),
        ([6511, 6512], 0.1, ["yumi_left"], "got 1 robots and 2 ports"),
    ],
)
def test_what_cannot_be_examined(ports: list[int], seconds: float, arms: Any, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        examine(ports, seconds, arms)


@contextmanager
def streaming(*peers: Any) -> Iterator[None]:
    over = threading.Event()

    def play() -> None:
        while not over.wait(0.002):
            for peer in peers:
                peer.send()

    thread = threading.Thread(target=play, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join(10)


def listened(number: int, seconds: float = 0.01, robot: Robot | None = None) -> dict[str, Finding]:
    """Return the findings at one port, by the second part of their names."""
    found = listen([number], seconds, [robot], requested=True)
    return {finding.name.partition(", ")[2]: finding for finding in found}


def test_a_port_that_another_holds() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("0.0.0.0", 0))
        number = other.getsockname()[1]
        (found,) = listen([number], 0.01, [None], requested=True)
    assert (found.name, found.verdict) == (f"port {number}", "failure")
    assert f"process {os.getpid()}" in found.advice


def test_silence_is_told_once_when_nobody_asked() -> None:
    one, two = free_port(), free_port()
    for asked in (False, True):
        found = {finding.name: finding for finding in listen([one, two], 0.01, [None, None], requested=asked)}
        assert found[f"port {one}"].verdict == "ok"
        assert found[f"port {one}, self-test"].verdict == "ok"
        assert found[f"port {one}, packets"].verdict == "warning"
        assert (f"port {two}, packets" in found) == asked


def test_robots_are_heard_and_get_nothing(robot: Robot, make_peer: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    number = free_port()
    first, second = make_peer(robot, number), make_peer(robot, number)
    with streaming(first):
        found = listened(number, 0.1, robot)
        monkeypatch.setattr(report, "route_to", lambda host: "")
        lost = listened(number, 0.1, robot)["route"]
    assert "7 axes" in found["first packet"].value
    assert "leave from 127.0.0.1" in found["route"].value
    assert found["senders"].verdict == "ok"
    assert f"from 127.0.0.1:{first.socket.getsockname()[1]}" in found["packets"].value
    assert lost.verdict == "failure"
    assert "network of 127.0.0.1" in lost.advice
    with streaming(first, second):
        assert listened(number, 0.1, robot)["senders"].verdict == "failure"
    assert first.surplus() == second.surplus() == 0


def test_a_rule_that_drops_packets(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report, "local_addresses", lambda: {"eth9": "203.0.113.9"})
    found = listened(free_port())["self-test"]
    assert found.verdict == "failure"
    assert "203.0.113.9" in found.advice


PERIOD_NS = 4_032_000
SOURCE = ("192.0.2.7", 40_000)
RIGHT = robots.load("yumi_right")


class Line:
    """Source of robot packets at times set by the test."""

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
def line(robot: Robot) -> Line:
    return Line(robot, EgmListener(6510, robot))


def test_a_robot_that_is_ready(line: Line, monkeypatch: pytest.MonkeyPatch) -> None:
    for k in range(100):
        line(k)
    monkeypatch.setattr("armlab.bridge.doctor.report.time.monotonic_ns", lambda: line.now)
    found = judged(line.heard)
    assert {finding.verdict for finding in found.values()} == {"ok"}
    assert "100.0/s from 192.0.2.7:40000" in found["packets"].value
    assert "period 4.032 ms" in found["timing"].value
    assert "RobotWare 6.10, 7 axes" in found["first packet"].value
    assert found["guidance"].value == "ready for references"
    assert found["sessions"].value == "1"
    assert "robot minus computer" in found["clock"].value
    assert "absent" in found["extension"].value
    line.codec = RobotSideCodec(line.robot, extension=True)
    line(100, qd=np.zeros(7), tau=np.zeros(7))
    assert "present" in judged(line.heard)["extension"].value


def test_silence(line: Line) -> None:
    heard = line.heard
    (finding,) = heard.findings(5.0)
    assert (finding.verdict, finding.value) == ("warning", "none in 5 s")
    for word in ("UDPUC", "EGMRunJoint", "ufw allow 6510/udp"):
        assert word in finding.advice
    for data in (b"", b"hello", b"\xff" * 40):
        heard.add(Arrival(data, SOURCE, 1))
        assert judged(heard)["first packet"].verdict == "failure"
    assert judged(heard)["first packet"].value.startswith("not a robot packet: ")


@pytest.mark.parametrize(
    ("sender", "robotware", "expected", "verdict", "value", "advice"),
    [
        ("irb120", "6.10", RIGHT, "failure", "wrong axes: 1 joint count", "not a yumi_right, which has 7 axes"),
        ("irb120", "6.10", None, "ok", "6 axes", ""),
        ("yumi_left", "6.10", None, "ok", "6 axes and 1 external, a YuMi's", ""),
        ("yumi_right", "6.06", RIGHT, "warning", "RobotWare 6.06", "radians"),
        ("yumi_right", "6.07", RIGHT, "warning", "RobotWare 6.07", "6.07.01"),
    ],
)
def test_the_first_packet(
    sender: str, robotware: str, expected: Robot | None, verdict: str, value: str, advice: str
) -> None:
    heard = EgmListener(6510, expected)
    line = Line(robots.load(sender), heard, robotware)
    line(0)
    found = judged(heard)
    assert found["first packet"].verdict == verdict
    assert value in found["first packet"].value
    assert advice in found["first packet"].advice
    if verdict == "ok":
        assert found["posture"].verdict == "ok"


OTHER = ("192.0.2.8", 50_000)
UNEVEN = [{"seqno": k, "after": PERIOD_NS + 3_000_000 * (k % 10 == 9)} for k in range(50)]
ENDED = [{"seqno": 0}, {"seqno": 1, "motors": 2}, {"seqno": 0, "after": 10**9}]


@pytest.mark.parametrize(
    ("packets", "name", "verdict", "value", "advice"),
    [
        ([{"seqno": 0}, {"seqno": 70, "source": OTHER}], "senders", "failure", "2", "a separate UDPUC device and port"),
        ([{"seqno": 0, "q": RIGHT.q_max + 1.0}], "posture", "failure", "q = ", "Usual causes"),
        ([{"seqno": 0, "motors": 2}], "guidance", "warning", "the motors are off", "enabling device"),
        ([{"seqno": 0, "rapid": 1}], "guidance", "warning", "RAPID is stopped", "from main"),
        ([{"seqno": 0, "mci": 2}], "guidance", "warning", "guidance has not begun", "EGMRunJoint"),
        ([{"seqno": k} for k in (0, 1, 1, 4, 5)], "timing", "warning", "2 lost, 1 repeated", "cable"),
        (UNEVEN, "timing", "warning", "0 lost, 0 repeated", "cable"),
        (ENDED, "sessions", "warning", "2, last end: the", "CommTimeout"),
    ],
)
def test_what_packets_tell(line: Line, packets: Any, name: str, verdict: str, value: str, advice: str) -> None:
    for packet in packets:
        line(**packet)
    found = judged(line.heard)[name]
    assert found.verdict == verdict
    assert value in found.value
    assert advice in found.advice
