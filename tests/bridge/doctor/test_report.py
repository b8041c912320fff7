"""Checks of the computer: each on its good and on its bad side."""

from __future__ import annotations

import importlib.metadata
import os
import socket
from pathlib import Path
from typing import get_args

import pytest

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
from armlab.bridge.doctor.report import DEFAULT_PORTS, LONGEST, examine
from armlab.errors import ConfigError
from armlab.robots import Robot


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
