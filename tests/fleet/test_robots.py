"""`list_robots`: which robots are there, and how their rows come."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from armlab.bridge.zenoh import EVERY, Place
from armlab.fleet import FleetRobot, Router, list_robots

from .conftest import Started, free_port


def test_nobody_is_there() -> None:
    with Router(port=(port := free_port())):
        assert list_robots(Place(port=port, lab=EVERY)) == []


@pytest.mark.slow
def test_robots_and_how_they_do(processes: Callable[..., Started]) -> None:
    with Router(port=(port := free_port())):
        for name in ("yumi_left", "ur5e"):
            processes("publisher", port, name)
        found: list[FleetRobot] = []
        for _ in range(10):  # bridges that have just begun are found one after the other
            found = list_robots(Place(port=port, lab="lab1"), 1.0)
            if len(found) == 2 and all(one.rate > 0.0 for one in found):
                break
    assert [(one.lab, one.robot, one.commander) for one in found] == [("lab1", "ur5e", ""), ("lab1", "yumi_left", "")]
    for one in found:
        assert 100.0 < one.rate < 300.0
        assert one.loss >= 0
        assert math.isfinite(one.age)
        assert one.age < 5.0
    with Router(port=(port := free_port())):
        processes("publisher", port, "ur5e")
        assert list_robots(Place(port=port, lab="another"), 1.0) == []
