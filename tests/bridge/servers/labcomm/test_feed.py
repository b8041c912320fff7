"""Rows of a run to a server, and commands of a client to a run."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from armlab import bridge, robots
from armlab.bridge.servers.labcomm import ArmChannel, FusedChannel, Row, RowTypes
from armlab.bridge.servers.labcomm.server import RowFeed, to_arbiter
from armlab.state import Command, State
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


def test_commands_pass_the_rights_of_an_arbiter() -> None:
    arm = robots.load("yumi_left")
    arbiter, home = bridge.Arbiter([arm], ["labcomm"]), np.array(arm.q_home)
    here = State(0.0, 0.004, home, 0 * home, 0 * home, robot=arm.name)
    take = to_arbiter(arbiter, arm.name)
    assert arbiter(here) is None
    take("left", Row(1, home + 0.06), "far")
    assert arbiter(here) is None, "too far to begin"
    take("left", Row(1, home + 0.01, 0 * home), "near")
    command = arbiter(here)
    assert isinstance(command, Command)
    assert np.allclose(command.q, home + 0.01)
    assert arbiter.commander(arm.name) == "labcomm near"
    assert arbiter.refused == {"labcomm far": 1}


CALLED = [("abb", "axis_7 (number 7 of the vector)"), ("chain", "joint 3 (axis_7)")]


@pytest.mark.parametrize(("order", "called"), CALLED)
def test_a_refusal_names_the_number_that_the_client_sent(order: Any, called: str) -> None:
    """The third joint from the base is ABB's axis 7: where its number stands depends on the order of the port."""
    arm = robots.load("yumi_left")
    said: list[str] = []
    arbiter = bridge.Arbiter([arm], ["labcomm"], answer=lambda client, text: said.append(text))
    home, types = np.array(arm.q_home), RowTypes(arm.abb_axes, order)
    far = home.copy()
    far[2] += 0.5
    sent = types.value(Row(1, far))["pos"]
    to_arbiter(arbiter, arm.name, order)("left", types.command({"pos": sent}), "far")
    arbiter(State(0.0, 0.004, home, 0 * home, 0 * home, robot=arm.name))
    (text,) = said
    assert f"got {far[2]:.4f} for {called} of yumi_left" in text
    assert sent[6 if order == "abb" else 2] == far[2]
