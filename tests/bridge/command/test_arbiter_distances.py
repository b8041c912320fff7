"""How far a position may be for a client to take an arm, and to keep it."""

from __future__ import annotations

import numpy as np

from armlab import robots
from armlab.bridge.command.order import Order

from .commanders import HOME, Bench, order


def test_a_jump_is_refused_and_the_last_command_stays() -> None:
    bench = Bench()
    bench(order())
    assert bench(order(offset=0.2)).q[0] == HOME[0] + 0.01
    assert "Expected the position within 0.1 of the one last sent" in bench.answers[0][1]
    bench.q_sent["yumi_left"] = HOME + 0.2  # held elsewhere meanwhile
    assert bench() is None
    assert bench(order("labcomm b")) is None, "what is refused makes no old command new"
    assert bench(order(offset=np.nan)) is None


def test_a_commander_may_lead_the_arm_further_than_it_may_enter() -> None:
    """The first position counts from the joints measured, those after it from the one sent last."""
    bench = Bench()
    for offset in (0.04, 0.08, 0.12):
        assert bench(order(offset=offset)).q[0] == HOME[0] + offset
    assert bench.events == ["labcomm a commands yumi_left."]


def test_a_first_command_far_from_what_was_sent_is_for_the_guide_to_refuse() -> None:
    """Which says why; an arm that was pushed away from where it holds would else not move, and no one know why."""
    bench = Bench()
    bench.q_sent["yumi_left"] = HOME + 0.2
    assert bench(order()) is not None


def test_before_anything_was_sent_the_measured_joints_count() -> None:
    bench = Bench()
    for offset, taken in ((0.01, 0.01), (0.02, 0.02), (0.2, 0.02)):
        bench.q_sent["yumi_left"] = np.full(7, np.nan)
        assert bench(order(offset=offset)).q[0] == HOME[0] + taken


def test_distances_are_those_of_the_axes_where_these_are_not_the_joints() -> None:
    """Of an IRB 2400 axis 3 is the sum of joints 2 and 3; the guide would refuse its jump, three times, and stop."""
    linked = robots.load("irb2400")
    bench = Bench((linked,))

    def at(second: float, third: float) -> np.ndarray:
        return linked.q_home + np.array([0.0, second, third, 0.0, 0.0, 0.0])

    def away(second: float, third: float) -> Order:
        return Order("labcomm a", linked.name, at(second, third))

    assert bench(away(0.03, 0.03)) is None
    assert "within 0.05 of the one measured, got" in bench.answers[0][1]
    assert bench(away(0.049, -0.049)) is not None
    bench.now += 10**9
    bench(away(0.0, 0.0))
    assert bench(away(0.095, 0.095)).q[1] == linked.q_home[1]
    axis = linked.q_home[1] + linked.q_home[2]
    assert f"got {axis + 0.19:.4f} for joint 3 (axis_3) of irb2400, last sent {axis:.4f}." in bench.answers[1][1]
    assert "ABB's axes" in bench.answers[1][1]
    bench.q_sent[linked.name] = at(0.06, 0.06)  # held elsewhere meanwhile
    assert bench() is None
    bench.q_sent[linked.name] = at(0.06, -0.06)
    assert bench() is not None


def test_the_ends_of_what_is_allowed_are_within() -> None:
    q = HOME + 0.05 * (np.arange(7) == 0)
    bench = Bench(entry=abs(q[0] - HOME[0]))
    assert bench(Order("labcomm a", "yumi_left", q)) is not None
    bench.arbiter._jumps["yumi_left"] = np.abs(q - HOME)
    bench.q_sent["yumi_left"] = HOME
    assert bench() is not None


def test_a_sliding_joint_enters_as_near_as_its_arm_takes_it() -> None:
    """0.02 m: what the arm itself would not take, and hold for, is refused, and the client told."""
    rail = robots.from_dh(
        "rail", 0.0, [0.0, 0.3], 0.0, prismatic=[True, False], q_min=[-1, -3], q_max=[1, 3], qd_max=[0.5, 2]
    )
    bench = Bench((rail,))
    assert bench(Order("labcomm a", "rail", rail.q_home + np.array([0.03, 0.0]))) is None
    assert "within 0.02 of the one measured" in bench.answers[0][1]
    assert bench(Order("labcomm a", "rail", rail.q_home + np.array([0.019, 0.049]))) is not None
