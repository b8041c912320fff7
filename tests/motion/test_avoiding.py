"""Sample by sample among obstacles: the same numbers as the rollout, obstacles that move, and the control loop."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import Command, State, kinematics, robots
from armlab.errors import ShapeError
from armlab.motion import Dmp, fit_dmp
from armlab.motion.avoiding import AvoidingController, AvoidingStepper
from armlab.motion.obstacles import AvoidingDmp, Capsule

U = np.linspace(0.0, 1.0, 251)
S = U**3 * (10 - 15 * U + 6 * U**2)
ROBOT = robots.load("yumi_right")
PERIOD = 0.004


@pytest.fixture(scope="module")
def space() -> Dmp:
    return fit_dmp(U, np.stack([0.5 * S, 0.1 * np.sin(np.pi * S), 0.2 * S], axis=1), n_basis=20).value


@pytest.fixture(scope="module")
def arm() -> Dmp:
    q = ROBOT.q_home + S[:, None] * [1.1, 0.1, 0.2, 0.2, -0.3, 0.4, 0.2]
    return fit_dmp(2 * U, q, n_basis=20, scaling="none").value


def test_steps_are_the_rollout(space: Dmp) -> None:
    one = AvoidingDmp(space, [Capsule.sphere([0.25, 0.1, 0.1], 0.03)], 0.02, 0.1)
    run, stepper = one.rollout(PERIOD), one.stepper()
    assert isinstance(stepper, AvoidingStepper)
    for _ in range(2):
        steps = [stepper.state, *(stepper.step(PERIOD) for _ in run.t[1:])]
        np.testing.assert_allclose(steps, np.stack([run.y, run.yd, run.ydd], axis=1), rtol=0, atol=1e-10)
        stepper.reset()


def test_a_new_goal_within_the_clearance_is_refused(space: Dmp) -> None:
    """Of where the obstacle is now: the motion would never be done. The old goal stays."""
    stepper = AvoidingDmp(space, [Capsule.sphere([0.25, 0.3, 0.1], 0.03)], 0.02, 0.1).stepper()
    free, taken = [0.6, 0.1, 0.1], [0.25, 0.26, 0.1]
    stepper.change_goal(free)
    with pytest.raises(ShapeError, match=r"goal outside the clearance of every obstacle, got one 0\.01"):
        stepper.change_goal(taken)
    with pytest.raises(ShapeError, match="3 coordinates"):
        stepper.change_goal([0.1])
    np.testing.assert_array_equal(stepper.goal, free)
    stepper.place([])
    stepper.change_goal(taken)
    np.testing.assert_array_equal(stepper.goal, taken)


def test_order_of_the_steps(space: Dmp) -> None:
    """Where nothing but steering acts, whose terms are smooth: of fourth order."""
    one = AvoidingDmp(space, [Capsule.sphere([0.25, 0.2, 0.1], 0.03)], 0.0, 0.15)
    ends = [one.rollout(np.linspace(0.0, 0.6, N)).y[-1] for N in (201, 401, 801, 3201)]
    assert np.abs(ends[-1] - space.rollout([0.0, 0.6]).y[-1]).max() > 1e-4  # it acted
    errors = [np.abs(end - ends[-1]).max() for end in ends[:-1]]
    assert errors[0] / errors[2] > 16**2 * 0.4


def test_an_obstacle_that_moves_is_made_way_for(space: Dmp) -> None:
    """It comes from the side with 0.4 m/s, and is told where it is every 0.1 s, or only once with its velocity."""
    velocity = np.array([0.0, -0.4, 0.0])
    for told in (25, 10_000):
        stepper = AvoidingDmp(space, [], 0.02, 0.1).stepper()
        seen = []
        for k in range(500):
            if k % told == 0:
                stepper.place([Capsule.sphere([0.25, 0.3, 0.1] + velocity * k * PERIOD, 0.03, velocity)])
            stepper.step(PERIOD)
            seen.append(stepper.distance)
        where = np.array([0.25, 0.3, 0.1]) + velocity * 2.0
        assert seen[-1] == pytest.approx(np.linalg.norm(stepper.state[0] - where) - 0.03, abs=1e-9)
        assert min(seen) > 0.02 - 1e-4
        np.testing.assert_allclose(stepper.state[0], space.g, atol=1e-3)


class Ideal:
    """An arm that is where it was told to be."""

    def __init__(self) -> None:
        self.q, self.t = ROBOT.q_home.copy(), 0.0

    def packet(self, controller: AvoidingController) -> Command:
        command = controller(State(self.t, PERIOD, self.q, np.zeros(7), self.q))
        self.t += PERIOD
        if command.q is not None:
            self.q = command.q
        return command


def test_a_controller_goes_around_what_is_put_in_its_way(arm: Dmp) -> None:
    path = arm.rollout(PERIOD).y
    one = AvoidingDmp(arm, [], 0.02, 0.1, robot=ROBOT)
    controller, yumi = one.controller(), Ideal()
    assert "distance" in controller.columns()
    least = []
    for k in range(1000):
        if k == 50:
            there = kinematics.forward(ROBOT, path[250])[:3, 3] + np.array([0.0, 0.0, 0.03])
            controller.place([Capsule.sphere(there, 0.02)])
        record = yumi.packet(controller).record
        least.append(float(record["distance"]))
        assert not controller.clamped.any()
    assert np.isinf(least[:50]).all()
    assert 0.02 - 1e-4 < min(least[50:]) < 0.025
    np.testing.assert_allclose(yumi.q, arm.g, atol=2e-3)
    assert controller.done


def test_a_start_within_the_clearance_ends_the_run_with_the_reason(arm: Dmp) -> None:
    controller, yumi = AvoidingDmp(arm, [], 0.02, 0.1, robot=ROBOT).controller(), Ideal()
    controller.place([Capsule.sphere(kinematics.forward(ROBOT, ROBOT.q_home)[:3, 3])])
    assert yumi.packet(controller).ends
    assert controller.reason.startswith("Expected the start outside the clearance")


def test_a_controller_keeps_its_goal_where_the_new_one_is_within_the_clearance(arm: Dmp) -> None:
    controller, yumi = AvoidingDmp(arm, [], 0.02, 0.1, robot=ROBOT).controller(), Ideal()
    yumi.packet(controller)
    new = arm.g + 0.1
    controller.place([Capsule.sphere(kinematics.forward(ROBOT, new)[:3, 3])])
    with pytest.raises(ShapeError, match="Expected the goal outside the clearance"):
        controller.goal = new
    np.testing.assert_array_equal(controller.goal, arm.g)
