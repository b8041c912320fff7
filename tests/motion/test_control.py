"""Motion controllers of each kind: no jumps, correct timing, limits applied last, changes of goal and speed, stops."""

from __future__ import annotations

import subprocess
import sys
import tracemalloc
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from armlab import State, bridge, robots
from armlab.errors import ShapeError
from armlab.log import Column, Table
from armlab.log.column import resolved
from armlab.motion import Dmp, TwoDofDmp
from armlab.motion.control import Arms, Controller, robots_of

from .conftest import arm

PERIOD = 0.004032
ROBOT = robots.load("yumi_right")


def made(dmp: Dmp, kind: str, **more: Any) -> Controller:
    return dmp.controller(ROBOT, **more) if kind == "plain" else TwoDofDmp(dmp, e0=0.02).controller(ROBOT, **more)


KINDS = pytest.mark.parametrize("kind", ["plain", "two_dof"])


@KINDS
def test_from_where_the_arm_is_to_the_goal_without_a_jump(reach: Dmp, kind: str) -> None:
    controller, start = made(reach, kind), arm(ROBOT.q_home + 0.05)
    q, qd = start.run(controller, 3.0)
    np.testing.assert_array_equal(q[0], ROBOT.q_home + 0.05)
    np.testing.assert_array_equal(qd[0], 0.0)
    assert np.abs(np.diff(q, axis=0)).max() < 0.01
    np.testing.assert_allclose(np.diff(q, axis=0) / PERIOD, 0.5 * (qd[1:] + qd[:-1]), atol=5e-3)
    np.testing.assert_allclose(q[-1], reach.g, atol=5e-3)
    assert controller.done
    assert not controller.clamped.any()
    assert controller.reason == ""


@KINDS
def test_packets_that_come_late_do_not_bend_the_path(reach: Dmp, kind: str) -> None:
    """Packets are lost repeatedly, up to nine in a row, but the motion stays on time.

    The arm keeps the last commanded acceleration, so with two degrees of freedom it is only close.
    """
    even, q = made(reach, kind), arm()
    path, _ = q.run(even, 2.5)
    late, other, k, draw = made(reach, kind), arm(), 0, np.random.default_rng(0)
    other.packet(late)
    while k < len(path) - 12:
        skip = int(draw.choice([1, 1, 1, 2, 10 if kind == "plain" else 3]))
        k += skip
        command = other.packet(late, skip * PERIOD)
        np.testing.assert_allclose(command.q, path[k], atol=1e-8 if kind == "plain" else 0.02)


@KINDS
def test_a_gap_ends_the_run_and_says_so(reach: Dmp, kind: str) -> None:
    controller, yumi = made(reach, kind), arm()
    yumi.run(controller, 0.5)
    command = yumi.packet(controller, 0.06)
    assert command.ends
    assert controller.reason == "Expected packets at most 50 ms apart, got 60.0 ms."
    assert yumi.packet(controller).ends
    lost = made(reach, kind)
    assert arm(np.full(7, np.nan)).packet(lost).ends
    assert "NaN" in lost.reason


def test_what_goes_wrong_in_the_loop_ends_the_run_with_its_reason(reach: Dmp) -> None:
    """A force that is NaN, and a motion that cannot begin."""
    pushed = TwoDofDmp(reach).controller(ROBOT, give_way=lambda _: np.full(7, np.nan))
    yumi = arm()
    yumi.packet(pushed)
    assert yumi.packet(pushed).ends
    assert "finite reference" in pushed.reason

    stuck, turned = made(reach, "plain"), arm()
    stuck._begin = lambda state: stuck._checked(ROBOT.q_max + 1)  # pyright: ignore[reportAttributeAccessIssue]
    assert turned.packet(stuck).ends
    assert stuck.reason.startswith("Expected a goal within the limits")


@KINDS
def test_a_new_session_begins_anew_where_the_arm_is(reach: Dmp, kind: str) -> None:
    controller, yumi = made(reach, kind), arm()
    yumi.run(controller, 1.0)
    yumi.q = ROBOT.q_home - 0.02
    command = yumi.packet(controller, 0.5, session=2)
    np.testing.assert_array_equal(command.q, yumi.q)
    np.testing.assert_array_equal(command.qd, 0.0)


@KINDS
def test_limits_act_last_and_are_told(reach: Dmp, kind: str) -> None:
    slow = bridge.Limits.of(ROBOT, speed=0.05)
    controller, yumi, bits = made(reach, kind, limits=slow), arm(), 0
    q, qd = [], []
    for _ in range(round(6 / PERIOD)):
        command = yumi.packet(controller)
        bits |= int(np.bitwise_or.reduce(controller.clamped))
        np.testing.assert_array_equal(command.record["limited"], controller.clamped)
        q.append(command.q)
        qd.append(command.qd)
    assert bits & 2
    assert (np.abs(qd) <= slow.qd_max * (1 + 1e-9)).all()
    assert (np.abs(np.diff(qd, axis=0)) <= slow.qdd_max * PERIOD * (1 + 1e-9)).all()
    if kind == "two_dof":  # it waits for itself
        np.testing.assert_allclose(q[-1], reach.g, atol=5e-3)
        assert controller.done


@KINDS
def test_speed_and_stop_keep_the_path(reach: Dmp, kind: str) -> None:
    """Slowing down, stopping and resuming: the same curve in joint space at other times."""
    plain, _ = arm().run(made(reach, kind), 3.0)
    controller, yumi = made(reach, kind), arm()
    first, _ = yumi.run(controller, 0.6)
    controller.speed = 0.4
    second, _ = yumi.run(controller, 0.6)
    controller.stop()
    third, qd = yumi.run(controller, 1.5)
    assert np.abs(qd[-1]).max() < 1e-3
    assert controller.speed == 0.0
    assert not controller.done
    controller.speed = 1.5
    fourth, _ = yumi.run(controller, 2.5)
    assert controller.done
    walked = np.concatenate([first, second, third, fourth])
    apart = np.abs(walked[:, None] - plain).max(axis=2).min(axis=1)
    assert apart.max() < (5e-3 if kind == "plain" else 0.03)
    np.testing.assert_allclose(walked[-1], plain[-1], atol=5e-3)


@KINDS
def test_done_is_near_slow_and_over_for_a_tenth_of_a_second(reach: Dmp, kind: str) -> None:
    """An arm that reports the goal from the start has not arrived before the motion is over."""

    def arrivals(seconds: float, q: np.ndarray, qd: np.ndarray, spoilt: int = -1) -> np.ndarray:
        controller = TwoDofDmp(reach, kc=0.0).controller(ROBOT) if kind == "two_dof" else made(reach, kind)
        done = []
        for k in range(round(seconds / PERIOD)):
            controller(State(k * PERIOD, PERIOD, q, qd + (0.1 if k == spoilt else 0.0), q))
            done.append(controller.done)
        return np.flatnonzero(done)

    rest = np.zeros(7)
    first = arrivals(2.3, reach.g, rest)[0]
    assert 2.1 <= first * PERIOD <= 2.1 + 3 * PERIOD
    assert not len(arrivals(2.3, reach.g + 0.011 * np.eye(7)[2], rest))
    assert not len(arrivals(2.3, reach.g, np.array([0, 0, 0, 0.021, 0, 0, 0])))
    assert arrivals(2.3, reach.g, rest, first - 5)[0] == first - 5 + 25


def test_lost_measurements_do_not_keep_a_motion_from_being_done(reach: Dmp) -> None:
    controller = made(reach, "two_dof")
    for k in range(round(2.6 / PERIOD)):
        lost = np.nan if k % 10 == 5 else 0.0
        controller(State(k * PERIOD, PERIOD, reach.g + lost, np.zeros(7) + lost, reach.g))
    assert controller.done
    assert controller.reason == ""


def test_a_stop_takes_a_quarter_of_a_second(reach: Dmp) -> None:
    controller, yumi = made(reach, "plain"), arm()
    yumi.run(controller, 0.8)
    controller.stop()
    q, _ = yumi.run(controller, 0.5)
    moves = np.abs(np.diff(q, axis=0)).max(axis=1) > 1e-6
    last = int(np.flatnonzero(moves)[-1]) * PERIOD
    assert 0.22 < last < 0.26


@KINDS
def test_the_goal_may_change_on_the_way(reach: Dmp, kind: str) -> None:
    controller, yumi = made(reach, kind), arm()
    yumi.run(controller, 0.8)
    goal = reach.g + np.array([0.2, 0, -0.1, 0, 0.1, 0, 0])
    before = yumi.q
    controller.goal = goal
    assert np.abs(yumi.packet(controller).q - before).max() < 0.01
    q, _ = yumi.run(controller, 3.0)
    np.testing.assert_allclose(q[-1], goal, atol=5e-3)
    np.testing.assert_array_equal(controller.goal, goal)
    assert controller.done
    controller.goal = goal + 0.05
    yumi.packet(controller)
    assert not controller.done, "another goal is not yet arrived at"


def test_what_it_records_is_declared(reach: Dmp) -> None:
    controller = made(reach, "two_dof")
    record, columns = arm().packet(controller).record, controller.columns()
    assert record.keys() == columns.keys()
    for name, column in columns.items():
        assert isinstance(column, Column)
        assert np.shape(record[name]) == resolved(column, name).shape


def test_several_arms_are_one_motion(reach: Dmp) -> None:
    """A State of two arms concatenates their joints; each arm has its own limits."""
    left = robots.load("yumi_left")
    arms: Arms = (left, ROBOT)
    assert robots_of(arms) == arms
    assert robots_of(left) == (left,)
    both = {name: np.tile(getattr(reach, name), 2) for name in ("v0", "extent", "peak_acceleration", "monotone")}
    start, goal = np.r_[left.q_home, ROBOT.q_home], np.r_[left.q_home, reach.g]
    wide = replace(reach, weights=np.tile(reach.weights, 2) * np.r_[np.zeros(7), np.ones(7)], y0=start, g=goal, **both)
    limits = [bridge.Limits.of(arm, speed=0.5) for arm in arms]
    controller = TwoDofDmp(wide).controller(arms, limits=limits)
    command = controller(State(0.0, PERIOD, start, np.zeros(14), start))
    np.testing.assert_array_equal(command.q, start)
    np.testing.assert_array_equal(controller.goal, goal)
    assert controller.columns()["path"].shape == (14,)
    with pytest.raises(ShapeError, match="yumi_left"):
        wide.controller(arms, limits=limits[:1])
    with pytest.raises(ShapeError, match="yumi_left and yumi_right, got 7"):
        reach.controller(arms)


@KINDS
def test_calls_leave_nothing_behind(reach: Dmp, kind: str) -> None:
    controller, q = made(reach, kind), arm().q
    states = [State(k * PERIOD, PERIOD, q, np.zeros_like(q), q) for k in range(1100)]
    for state in states[:100]:
        controller(state)
    tracemalloc.start()
    try:
        blocks = sys.getallocatedblocks()
        for state in states[100:]:
            controller(state)
        assert sys.getallocatedblocks() - blocks < 20  # of a thousand calls
        assert tracemalloc.get_traced_memory()[1] < 20_000  # bytes at any time of them: a reference and its record
    finally:
        tracemalloc.stop()


def test_importing_motions_loads_no_logs() -> None:
    heavy = "('armlab.log', 'scipy', 'ruckig', 'matplotlib')"
    code = f"import sys, armlab.motion; print(*(name for name in {heavy} if name in sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "\n"


def test_a_plain_primitive_is_its_rollout(reach: Dmp) -> None:
    """The motion starts at rest, however the demonstration started."""
    moving = replace(reach, v0=np.full(7, 0.1))
    q, _ = arm().run(moving.controller(ROBOT, duration=3.0), 3.0)
    path = reach.rollout(PERIOD * np.arange(len(q)), duration=3.0, v0=np.zeros(7))
    np.testing.assert_allclose(q, path.y, atol=1e-9)


def test_a_held_arm_is_waited_for(reach: Dmp) -> None:
    """Unlike the plain primitive, it resumes after a two-second hold where it was, not where it would have been."""
    for e_max, frozen in ((0.3, False), (0.01, True)):  # when frozen, the path stands still and reports it
        controller = TwoDofDmp(reach, e_max=e_max).controller(ROBOT, give_way=lambda _: np.zeros(7))
        yumi = arm()
        yumi.run(controller, 0.8)
        where, yumi.held = yumi.q, True
        last = [yumi.packet(controller) for _ in range(round(2 / PERIOD))][-1]
        assert np.abs(last.record["path"] - where).max() < 0.1
        assert (last.record["done"], last.record["frozen"], controller.frozen) == (False, frozen, frozen)


def test_it_gives_way_to_what_a_contact_adds(reach: Dmp) -> None:
    free, _ = arm().run(TwoDofDmp(reach, kc=0).controller(ROBOT), 0.5)
    pushed, _ = arm().run(TwoDofDmp(reach, kc=0).controller(ROBOT, give_way=lambda state: np.eye(7)[0]), 0.5)
    assert pushed[-1, 0] - free[-1, 0] > 0.01


def test_a_log_of_the_loop_is_a_run(reach: Dmp) -> None:
    """`plots.two_dof` draws the columns that the controller records, from a Table of any source."""
    two_dof, yumi = TwoDofDmp(reach), arm()
    controller = two_dof.controller(ROBOT)
    rows = []
    for k in range(300):
        yumi.held = 100 <= k < 200
        q, qd = yumi.q, yumi.qd
        rows.append({"q": q, "qd": qd, **yumi.packet(controller).record})
    columns = controller.columns()
    values = {name: np.array([row[name] for row in rows], dtype=float) for name in rows[0]}
    values["path"][0] = np.nan  # a packet for which the controller was not called
    table = Table(PERIOD * np.arange(300), values, columns=columns)
    run = two_dof.recorded(table, [(0.4, 0.8)])
    np.testing.assert_array_equal(run.yc, values["path"][1:])
    np.testing.assert_array_equal(run.ya, values["q"][1:])
    assert (run.t[0], run.disturbed) == (0.0, ((0.4, 0.8),))
    assert run.tau_a.max() > 5 * reach.tau_d
    np.testing.assert_array_equal(run.free.y[0], values["q"][1])
    with pytest.raises(ShapeError, match="all rows of the column path"):
        two_dof.recorded(table.rows(slice(0, 1)))
