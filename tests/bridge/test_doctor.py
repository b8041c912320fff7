"""All checks together."""

from __future__ import annotations

import socket

import pytest

from armlab.bridge.doctor import DEFAULT_PORTS, LONGEST, examine
from armlab.errors import ConfigError
from armlab.robots import Robot


def test_every_question_is_answered() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("0.0.0.0", 0))
        number = one.getsockname()[1]
    found = examine([number], 0.05, wake_up=0.02)
    names = [finding.name for finding in found]
    assert len(set(names)) == len(names)
    for name in ("Python", "packages", "ROS", "wake-up", "addresses", "firewall", f"port {number}"):
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
