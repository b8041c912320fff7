"""`list_robots`: which robots are there, and how their rows come."""

from __future__ import annotations

import json
import math
from collections.abc import Callable

import pytest

from armlab import robots
from armlab.bridge.servers.row import RowSchema
from armlab.bridge.servers.zenoh import EVERY, Place
from armlab.fleet import FleetRobot, Router, list_robots
from armlab.fleet.robots import _Seen

from ..processes import PATIENCE, Started, free_port, until


def test_nobody_is_there() -> None:
    with Router(port=(port := free_port())):
        assert list_robots(Place(port=port, lab=EVERY)) == []


RATES = {"ur5e": 20.0, "yumi_left": 100.0, "yumi_right": 250.0}


@pytest.mark.slow
def test_robots_and_how_they_do(processes: Callable[..., Started]) -> None:
    """Three that send at different rates, and one of them damaged rows."""
    with Router(port=(port := free_port())):
        for name, rate in RATES.items():
            processes("publisher", port, name, name, str(1.0 / rate))
        found: list[FleetRobot] = []

        def rates_are_right() -> bool:
            """A publisher that was not run for a while catches up: the next look sees its rate."""
            found[:] = list_robots(Place(port=port, lab="lab1"), 2.0)
            return {one.robot for one in found} == set(RATES) and all(
                0.9 * RATES[one.robot] < one.rate < 1.1 * RATES[one.robot] for one in found
            )

        until(rates_are_right, 4.0 * PATIENCE)
        for one in found:
            assert (one.lab, one.commander, one.damaged) == ("lab1", "", 0)
            assert one.loss >= 0
            assert math.isfinite(one.age)
            assert one.age < 5.0
        assert list_robots(Place(port=port, lab="another"), 1.0) == []


def test_damaged_rows_are_counted_and_not_read() -> None:
    robot = robots.load("ur5e")
    schema, seen = RowSchema.of([robot]), _Seen("lab1", "ur5e")
    about = {"schema": schema.text.decode(), "robots": {robot.name: robots.to_toml(robot)}}
    seen.describe(json.dumps([about]).encode())
    seen.take(None)
    assert seen.summary()[2:5] == (0.0, 0, 1)


def test_a_bridge_that_says_what_cannot_be_read_is_shown_without_rows() -> None:
    seen = _Seen("lab1", "ur5e")
    seen.describe(b"[" * 200_000)
    seen.take(b"ALR1" + bytes(60))
    assert seen.summary()[2:5] == (0.0, 0, 0)
