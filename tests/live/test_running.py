"""`Running`: a bridge is found, followed and found again; what it says of forces."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.contact import Estimator
from armlab.errors import ConfigError, LinkError, ModelMismatchError, UnknownName
from armlab.live.live_bridge import Force
from armlab.log import Table
from armlab.models import TorqueModel
from armlab.state import State

from .fleet_bridges import Fleet

LEFT, RIGHT = robots.load("yumi_left"), robots.load("yumi_right")


def test_it_waits_for_a_bridge_and_follows_it(bridge: Any, following: Any, hear_until: Any) -> None:
    running = following()
    assert not running.hear(0.0)
    assert running.state.startswith("Waiting for a bridge")
    with pytest.raises(LinkError, match="none has come yet"):
        running.value("yumi_left", "q")
    one = bridge(LEFT, RIGHT)
    hear_until(running, lambda: running.robots)
    assert running.state == "Cell small"
    assert running.robots == {"yumi_left": LEFT, "yumi_right": RIGHT}, "to the last bit, as the bridge has them"
    q = np.linspace(0.1, 0.7, 7)
    hear_until(running, lambda: running.row, lambda: one.row(RIGHT, q=q))
    np.testing.assert_array_equal(running.value("yumi_right", "q"), q)
    assert np.isnan(running.value("yumi_left", "q")).all()
    assert [arm["arm"] for arm in running.watch.arms(time.time_ns())] == ["yumi_left", "yumi_right"]


def test_it_finds_the_bridge_again_that_started_again(bridge: Any, following: Any, hear_until: Any) -> None:
    running, one = following(), bridge(LEFT)
    hear_until(running, lambda: running.row, lambda: one.row(LEFT))
    arms = running.robots
    one.close()
    hear_until(running, lambda: "has ended" in running.state)
    assert running.row is not None, "the last picture stays"
    again = bridge(LEFT)
    hear_until(running, lambda: running.state == "Cell small")
    hear_until(running, lambda: running.row, lambda: again.row(LEFT))
    assert running.robots is arms, "the same arms need no new scene"
    again.close()
    hear_until(running, lambda: "has ended" in running.state)
    other = bridge(RIGHT)
    hear_until(running, lambda: "yumi_right" in running.robots)
    hear_until(running, lambda: running.row, lambda: other.row(RIGHT))
    assert running.robots == {"yumi_right": RIGHT}


def test_a_bridge_over_zenoh_is_waited_for_followed_and_found_again(
    fleet: Fleet, following: Any, hear_until: Any
) -> None:
    running = following(zenoh=f"zenoh://127.0.0.1:{fleet.port}/lab1")
    assert running.state.startswith("Waiting for a bridge at zenoh://127.0.0.1:")
    assert not running.hear(0.0)
    one = fleet.bridge(LEFT)
    one.q = LEFT.q_home + 0.3
    hear_until(running, lambda: running.row)
    assert running.state == "Cell yumi_left"
    assert running.robots == {"yumi_left": LEFT}
    np.testing.assert_array_equal(running.value("yumi_left", "q"), one.q)
    one.close()
    hear_until(running, lambda: "has ended" in running.state)
    fleet.bridge(RIGHT)
    hear_until(running, lambda: "yumi_right" in running.robots)
    running.row = None
    hear_until(running, lambda: running.row)
    with pytest.raises(ConfigError, match="Expected a place like zenoh"):
        following(zenoh="http://host")


def test_the_newest_counts_after_a_stall(bridge: Any, following: Any, hear_until: Any) -> None:
    """Whoever did not look for a while sees what is, not what was."""
    running, one = following(rate=1e6), bridge(LEFT)
    hear_until(running, lambda: running.row, lambda: one.row(LEFT))
    for k in range(20):
        one.row(LEFT, q=np.full(7, 0.01 * k))
    hear_until(running, lambda: running.value("yumi_left", "q")[0] == 0.19)


def test_one_arm_of_two(bridge: Any, following: Any, hear_until: Any) -> None:
    bridge(LEFT, RIGHT)
    running = following("yumi_right")
    hear_until(running, lambda: running.robots)
    assert list(running.robots) == ["yumi_right"]
    with pytest.raises(UnknownName, match="Known: yumi_left, yumi_right"):
        hear_until(following("ur5e"), lambda: False)


def test_several_bridges_need_a_name(bridge: Any, following: Any, hear_until: Any) -> None:
    bridge(LEFT, cell="a")
    bridge(RIGHT, cell="b")
    with pytest.raises(ConfigError, match="Give --cell NAME"):
        following().hear(0.0)
    running = following(cell="b")
    hear_until(running, lambda: running.robots)
    assert list(running.robots) == ["yumi_right"]


def test_the_force_comes_from_who_knows_most(bridge: Any, following: Any, hear_until: Any) -> None:
    one, running = bridge(LEFT), following()
    hear_until(running, lambda: running.row, lambda: one.row(LEFT))
    assert running.force("yumi_left") is None

    def heard(**fields: Any) -> Any:
        tick = running.value("yumi_left", "tick")
        hear_until(running, lambda: running.value("yumi_left", "tick") > tick, lambda: one.row(LEFT, **fields))
        return running.force("yumi_left")

    sensor, hat, cov = np.arange(6.0), np.arange(6.0) + 1.0, np.diag(np.arange(6.0) + 2.0)
    force = heard(wrench=sensor)
    np.testing.assert_array_equal(force.wrench, sensor)
    assert (force.covariance, force.origin) == (None, "force sensor")
    force = heard(wrench=sensor, record={"wrench_hat": hat, "wrench_hat_cov": cov})
    np.testing.assert_array_equal(force.wrench, hat)
    np.testing.assert_array_equal(force.covariance, cov)
    assert force.origin == "estimate of the controller"


def test_a_model_estimates_where_nobody_else_does(
    bridge: Any, following: Any, hear_until: Any, model: TorqueModel, excited: Table
) -> None:
    """The estimate is that of the same rows in a table; a row that was dropped makes the next step longer."""
    one, running = bridge(LEFT), following(models=[model])
    hear_until(running, lambda: running.robots)
    rows = np.r_[0:20, 23:40]
    wanted = Estimator(model, LEFT)
    for k in rows:
        fields = {name: excited[name][k] for name in ("q", "qd", "tau")}
        one.row(LEFT, t=excited.t[k], **fields)
        dt = excited.t[k] - excited.t[k - 1 if k != 23 else 19] if k else 0.004
        expected = wanted.step(State(excited.t[k], dt, **fields))
        hear_until(running, lambda k=k: running.row and running.value("yumi_left", "session_t") == excited.t[k])
    force = running.force("yumi_left")
    np.testing.assert_array_equal(force.wrench, expected.F)
    np.testing.assert_array_equal(force.covariance, expected.cov)
    assert isinstance(force, Force)
    assert force.origin == "estimate of the model"


def test_a_model_of_another_arm_is_refused(bridge: Any, following: Any, hear_until: Any, model: TorqueModel) -> None:
    bridge(RIGHT)
    with pytest.raises(ModelMismatchError, match="Expected a model of yumi_right, got one of 'yumi_left'"):
        hear_until(following(models=[model]), lambda: False)
