"""Rows of a run to a server, and commands of a client to a run."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from armlab.bridge.labcomm import ArmChannel, FusedChannel, Row
from armlab.bridge.labcomm import feed as module
from armlab.bridge.labcomm.feed import Commander, RowFeed
from armlab.state import State
from armlab.wire.labcomm import Sample

from .conftest import Started

TICK: Any = None


def state(robot: str, **fields: Any) -> State:
    return State(t=1.5, dt=0.004, q=np.arange(7.0), qd=np.zeros(7), tau=np.full(7, np.nan), robot=robot, **fields)


def test_rows_of_a_run_are_published(start: Callable[..., Started]) -> None:
    one = start(ArmChannel("left", 0), ArmChannel("right", 0), FusedChannel(0))
    feed = RowFeed(one.server, {"yumi_left": "left", "yumi_right": "right"})
    left, fused = one.client("left"), one.client("fused")
    feed.row(state("yumi_right"), None, TICK)
    feed.row(state("yumi_left", robot_ns=7_000_000, t_receive=9_000), None, TICK)
    feed.row(state("gripper"), None, TICK)
    feed.event("told", warn=True)
    value = left.read(3)[-1].value
    assert (value["tm"], value["pos"]) == (7, [0.0, 1.0, 3.0, 4.0, 5.0, 6.0, 2.0])
    assert np.isnan(value["trq"]).all()
    event = fused.read(3)[-1]
    assert isinstance(event, Sample)
    assert (event.value["t_us"], [arm["name"] for arm in event.value["arm"]]) == (9, ["right", "left"])
    assert event.value["arm"][0]["tm"] == 1500


def test_a_command_is_given_until_it_is_stale(monkeypatch: pytest.MonkeyPatch) -> None:
    class Clock:
        now = 10.0

        def monotonic(self) -> float:
            return self.now

    clock = Clock()
    monkeypatch.setattr(module, "time", clock)
    commander, now = Commander(), state("a")
    assert commander(now) is None
    commander.take("left", Row(1, now.q + 0.06, np.zeros(7)), "client")
    assert (commander(now), commander.refused) == (None, 1), "too far to begin"
    commander.take("left", Row(1, now.q + 0.04), "client")
    assert commander(now) is not None
    commander.take("left", Row(1, now.q + 0.5), "client")
    command = commander(now)
    assert command is not None
    assert command.q is not None
    assert np.allclose(command.q, now.q + 0.5), "the limits of the loop see to the rest"
    commander.take("left", Row(1, now.q + 0.5), "another client")
    assert commander(now) is None
    commander.take("left", Row(1, now.q), "client")
    clock.now += 0.11
    assert commander(now) is None
    commander.take("left", Row(1, now.q + 0.06), "client")
    assert commander(now) is None
    assert commander.refused == 3
