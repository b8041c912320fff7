"""`Running`: a bridge is found, followed and found again; the forces it reports."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest

from armlab import robots
from armlab.contact import Estimator
from armlab.errors import ConfigError, LinkError, ModelMismatchError, UnknownName
from armlab.kinematics import forward
from armlab.lie import se3
from armlab.live.live_bridge import Force, RunningView, watch
from armlab.log import Table
from armlab.models import TorqueModel
from armlab.robots.robot import Mesh
from armlab.state import State

from .fleet_bridges import Fleet
from .nodes import node, tip, tool

LEFT, RIGHT = robots.load("yumi_left"), robots.load("yumi_right")


def test_it_waits_for_a_bridge_and_follows_it(bridge: Any, following: Any, hear_until: Any) -> None:
    running = following()
    assert not running.hear(0.0)
    assert running.state.startswith("Waiting for a bridge")
    with pytest.raises(LinkError, match="got none yet"):
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


@pytest.mark.slow
def test_a_bridge_over_zenoh_is_waited_for_followed_and_found_again(
    fleet: Fleet, following: Any, hear_until: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("armlab.live.live_bridge._PATIENCE", 0.3)
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
    with pytest.raises(ConfigError, match="Expected an address such as zenoh"):
        following(zenoh="http://host")


def test_the_newest_counts_after_a_stall(bridge: Any, following: Any, hear_until: Any) -> None:
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


def test_a_description_of_the_bridge_brings_its_meshes(bridge: Any, following: Any, hear_until: Any) -> None:
    bridge(LEFT, RIGHT)
    mesh = Mesh("visual", "maker/link.stl", np.eye(4), np.ones(3))
    meshes = replace(LEFT, meshes=((mesh,), *[()] * LEFT.n))
    running = following(described=[meshes])
    hear_until(running, lambda: running.robots)
    assert running.robots["yumi_left"] is meshes
    assert running.robots["yumi_right"] == RIGHT
    for other, error, words in (
        (LEFT.with_tool(se3.from_rp(np.eye(3), [0.0, 0.0, 0.1])), ModelMismatchError, "tool moved by 0.1 m"),
        (robots.load("ur5e"), UnknownName, "Known: yumi_left, yumi_right"),
    ):
        with pytest.raises(error, match=words):
            hear_until(following(described=[other]), lambda: False)


def test_several_bridges_need_a_name(bridge: Any, following: Any, hear_until: Any) -> None:
    bridge(LEFT, cell="a")
    bridge(RIGHT, cell="b")
    with pytest.raises(ConfigError, match="Specify --cell NAME"):
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


@pytest.mark.slow
def test_a_model_estimates_where_nobody_else_does(
    bridge: Any, following: Any, hear_until: Any, model: TorqueModel, excited: Table
) -> None:
    one, running = bridge(LEFT), following(models=[model])
    hear_until(running, lambda: running.row, lambda: one.row(LEFT))  # from now on every row is sent
    rows = np.r_[0:20, 23:40]
    wanted = Estimator(model, LEFT)
    for k in rows:
        fields = {name: excited[name][k] for name in ("q", "qd", "tau")}
        one.row(LEFT, t=excited.t[k], session=2, **fields)
        dt = excited.t[k] - excited.t[k - 1 if k != 23 else 19] if k else 0.004
        expected = wanted.step(State(excited.t[k], dt, **fields))
        hear_until(running, lambda k=k: running.row and running.value("yumi_left", "session_t") == excited.t[k])
    force = running.force("yumi_left")
    np.testing.assert_array_equal(force.wrench, expected.wrench)
    np.testing.assert_array_equal(force.covariance, expected.cov)
    assert isinstance(force, Force)
    assert force.origin == "estimate from the model"


def test_a_model_of_another_arm_is_refused(bridge: Any, following: Any, hear_until: Any, model: TorqueModel) -> None:
    bridge(RIGHT)
    with pytest.raises(ModelMismatchError, match="Expected a model of yumi_right, got a model of 'yumi_left'"):
        hear_until(following(models=[model]), lambda: False)


LOOKS = 1000  # frames; only a failing test uses all of them
HAT = np.array([0.0, 0.0, 10.0, 0.0, 0.5, 0.0])


def data(view: RunningView, arm: str, plot: str) -> np.ndarray:
    columns = [
        [np.nan if value is None else value for value in msgspec.msgpack.decode(one)]
        if isinstance(one, msgspec.Raw)
        else one
        for one in getattr(view._arms[arm], f"_{plot}")._curves._plot.data
    ]
    return np.stack(columns)


def test_the_arms_are_drawn_as_the_bridge_has_them(server: Any, bridge: Any, following: Any, hear_until: Any) -> None:
    one, running = bridge(LEFT, RIGHT), following()
    view = RunningView(server, running)
    view.draw()
    assert "Waiting for a bridge" in view._state._html.content
    q = np.linspace(0.1, 0.7, 7)
    record = {"wrench_hat": HAT, "wrench_hat_cov": np.diag([1.0, 4.0, 9.0, 0.1, 0.1, 0.1])}
    row = {"q": q, "tau": np.arange(7.0), "later": 60.0}  # the row is not stale, however long this takes
    hear_until(running, lambda: running.row, lambda: one.row(RIGHT, record, **row))
    view.draw()
    T = forward(RIGHT, q)
    np.testing.assert_allclose(tool(server, "yumi_right", 7), T, atol=1e-9)
    arrow = node(server, "/yumi_right/force")
    assert arrow.visible
    np.testing.assert_allclose(tip(arrow) - T[:3, 3], [0.0, 0.0, 0.1], atol=1e-9)
    assert not node(server, "/yumi_left/arm").visible, "no row of this arm has arrived yet"
    np.testing.assert_allclose(data(view, "yumi_right", "torque")[1:, -1], np.arange(7.0))
    np.testing.assert_allclose(data(view, "yumi_right", "force")[1:4, -1], HAT[:3])
    np.testing.assert_allclose(data(view, "yumi_right", "force")[4:, -1], [2.0, -2.0, 4.0, -4.0, 16.0, 4.0])
    view._due = 0.0
    view.draw()
    said = view._arms["yumi_right"]._panel._words._html.content
    for word in ("the packets contain no motor state", "rate [Hz]", "clamps per joint", "estimate of the controller"):
        assert word in said
    assert view._state._html.content.count("Cell small") == 1


def test_a_silent_arm_shows_no_force_and_no_torque(server: Any, bridge: Any, following: Any, hear_until: Any) -> None:
    one, running = bridge(LEFT, RIGHT), following(rate=1e6)
    view = RunningView(server, running)
    hear_until(running, lambda: running.row, lambda: one.row(RIGHT, wrench=HAT))
    view.draw()
    assert node(server, "/yumi_right/force").visible
    hear_until(running, lambda: running.value("yumi_right", "age") > 0.5, lambda: one.row(LEFT, later=0.6))
    view.draw()
    assert not node(server, "/yumi_right/force").visible
    assert node(server, "/yumi_right/arm").visible
    assert np.isnan(data(view, "yumi_right", "torque")[1:, -1]).all(), "no line goes on"


def test_curves_and_path_do_not_bridge_a_gap(server: Any, bridge: Any, following: Any, hear_until: Any) -> None:
    one, running = bridge(LEFT), following(rate=1e6)
    view = RunningView(server, running)
    hear_until(running, lambda: running.robots)
    view.draw()  # makes the scene, which may take as long as a gap
    for _ in range(3):
        before = running.row
        hear_until(running, lambda before=before: running.row is not before, lambda: one.row(LEFT))
        view.draw()
    path = view._arms["yumi_left"]._path
    assert len(path) == 3
    last = running.row
    running.row = last._replace(mono_ns=last.mono_ns + 10**9, wall_ns=last.wall_ns + 10**9)
    view.draw()
    assert len(path) == 1
    torque = view._arms["yumi_left"]._torque._recent
    assert np.isnan(torque.values[:, :7]).all(axis=1).tolist() == [False, False, False, True, False]
    running.row = running.row._replace(wall_ns=running.row.wall_ns - 10**7)  # the clock of another arm in lockstep
    view.draw()
    assert len(torque) == 5
    running.row = last._replace(wall_ns=last.wall_ns - 10**10)  # the clock of another run
    view.draw()
    assert torque.t[-1] == 0.0


def test_other_arms_get_another_scene(server: Any, bridge: Any, following: Any, hear_until: Any) -> None:
    one, running = bridge(LEFT), following()
    view = RunningView(server, running)
    hear_until(running, lambda: running.row, lambda: one.row(LEFT))
    view.draw()
    one.close()
    other = bridge(RIGHT)
    hear_until(running, lambda: "yumi_right" in running.robots)
    view.draw()
    hear_until(running, lambda: running.row, lambda: other.row(RIGHT))
    view.draw()
    assert list(view._arms) == ["yumi_right"]
    assert server.scene.get_handle_by_name("/yumi_left") is None


def test_the_words_of_a_bridge_are_no_markup(server: Any, bridge: Any, following: Any, hear_until: Any) -> None:
    one, running = bridge(LEFT), following()
    view = RunningView(server, running)
    one.say("<script>alert(1)</script>")
    hear_until(running, lambda: running.watch.told)
    view.draw()
    assert "&lt;script&gt;" in view._notes._html.content


def test_nothing_is_drawn_while_nobody_looks(bridge: Any, page: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    one, told, pages, drawn = bridge(LEFT), [], [], []
    draw, rows = RunningView.draw, iter(range(LOOKS))

    def spied(view: RunningView) -> None:
        draw(view)
        drawn.append(len(data(view, "yumi_left", "torque")[0]) if view._arms else 0)

    def over() -> bool:
        one.row(LEFT)
        k = next(rows)
        if "Cell small" in told and k > 20 and not pages:
            assert not drawn
            pages.append(page(int(told[0].rpartition(":")[2])))
        return bool(drawn)

    monkeypatch.setattr(RunningView, "draw", spied)
    watch(opened=told.append, tell=told.append, port=0, over=over)
    pages[0].close()
    assert drawn[0] > 5
