"""Limits of an IRB 2400 are those of ABB's axes, and it moves over EGM."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import bridge, robots
from armlab.bridge.control.feedback import outside_range
from armlab.bridge.control.limits import Limiter, Limits, LinkedLimiter, axes_of, limiter_of
from armlab.bridge.control.torque import Torques
from armlab.state import Command, State
from armlab.wire.egm.linkage import Linkage

ROBOT = robots.load("irb2400")
T = 0.004


def test_which_robots_need_it() -> None:
    assert type(limiter_of(Limits.of(robots.load("irb120")), robots.load("irb120"))) is Limiter
    assert isinstance(limiter_of(Limits.of(ROBOT), ROBOT), LinkedLimiter)


def test_positions_that_limits_are_about() -> None:
    q = np.array([0.1, 0.2, 0.4, 0.0, 0.3, 0.0])
    np.testing.assert_allclose(axes_of(ROBOT)(q), [0.1, 0.2, 0.6, 0.0, 0.3, 0.0])
    assert axes_of(robots.load("irb120"))(q) is q


def test_the_sum_of_two_joints_is_limited() -> None:
    """Joints 2 and 3 each stay within their numbers, their sum would reach 68 degrees, the axis ends at 65."""
    limits = Limits.of(ROBOT)
    limiter = limiter_of(limits, ROBOT)
    q = np.radians([0.0, 40, 20, 0, 30, 0])
    np.testing.assert_allclose(limiter.rest(q).q, q)
    np.testing.assert_allclose(limiter.q, q)
    for _ in range(500):
        q = np.minimum(q + np.radians([0, 0.2, 0, 0, 0, 0]), np.radians([0, 48, 20, 0, 30, 0]))
        reply = limiter.step(q, None, T)
    axis = reply.q[1] + reply.q[2]
    assert axis == pytest.approx(np.radians(65.0) - 0.01, abs=1e-3)
    assert reply.clamped[2] & 9
    assert reply.q[1] == pytest.approx(np.radians(48.0), abs=1e-3), "axis 2 goes on"
    rest = limiter.hold(T)
    assert rest.q[1] + rest.q[2] <= limits.q_max[2]
    moving = limiter.follow(q, np.radians([0.0, 10, -10, 0, 0, 0]))
    np.testing.assert_allclose(moving.qd, np.radians([0.0, 10, -10, 0, 0, 0]), atol=1e-15)


def test_refusals_name_the_axis() -> None:
    limiter = limiter_of(Limits.of(ROBOT), ROBOT)
    limiter.rest(ROBOT.q_home)
    assert limiter.step(ROBOT.q_home + 0.5 * np.eye(6)[3], None, T).refused == -4
    assert limiter.step(np.full(6, np.nan), None, T).refused == 1


def test_feedback_is_plausible_where_the_axes_are_within_their_limits() -> None:
    """Lower arm forward by 60 degrees, upper arm level: joint 3 is at -60 - 50 degrees, and that is no mistake."""
    assert outside_range(np.radians([0, 60.0, -110, 0, 30, 0]), ROBOT) == ""
    assert "joint 3" in outside_range(np.radians([0, 60.0, 40, 0, 30, 0]), ROBOT)


def test_a_torque_alone_is_judged_by_the_axes() -> None:
    """Joint 3 at -110 degrees is axis 3 at -50, within its limits; joints 2 and 3 together may be beyond theirs."""
    torques = Torques(ROBOT, Limits.of(ROBOT, tau_max=1.0), frozenset(("torque",)))
    assert torques.outside(np.radians([0, 60.0, -110, 0, 30, 0]), np.zeros(6)) == ""
    assert "joint 3" in torques.outside(np.radians([0, 48.0, 20, 0, 30, 0]), np.zeros(6))


@pytest.mark.parametrize("lagging", [True, False])
def test_an_irb_2400_follows(lagging: bool) -> None:
    """Joints 2 and 3 against each other, so that axis 3 stands still, in lockstep with the simulated controller."""

    def controller(state: State) -> Command:
        sway = 0.2 * (1.0 - np.cos(2.0 * state.t))
        return Command(state.q_start + sway * np.array([0, 1, -1, 0, 0, 0]))

    with bridge.connect(f"sim://irb2400?lockstep=true&lagging={str(lagging).lower()}", ROBOT) as link:
        run = link.run(controller, seconds=3.0)
    table = run.table
    linkage = Linkage.of(ROBOT)
    assert linkage is not None
    moved = table["q"] - table["q"][0]
    assert moved[:, 1].max() == pytest.approx(0.4, abs=0.02)
    np.testing.assert_allclose(moved[:, 1] + moved[:, 2], 0.0, atol=1e-6 if lagging else 5e-3)
    assert not np.nan_to_num(table["clamped"][50:700]).any()
    np.testing.assert_allclose(table["q_planned"][-1], table["q_sent"][-1], atol=0.02)
