"""Hands that push, hold and lead the arm, and states that change at given times."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import robots
from armlab.errors import ShapeError
from armlab.lie import se3, so3
from armlab.sim.events import (
    DAMPING,
    MOTORS,
    RAPID,
    STIFFNESS,
    STRENGTH,
    AppliedWrench,
    Grip,
    HandPath,
    StateScript,
    Surroundings,
)


def test_readiness() -> None:
    assert Surroundings().is_ready(0.0)
    assert Surroundings(rapid=StateScript("undefined", RAPID)).is_ready(0.0)
    assert not Surroundings(rapid=StateScript("stopped", RAPID)).is_ready(0.0)
    assert not Surroundings(motors=StateScript("undefined", MOTORS)).is_ready(0.0)
    switched = Surroundings(motors=StateScript("0:off,1:on", MOTORS))
    assert [switched.is_ready(t) for t in (0.0, 0.99, 1.0)] == [False, False, True]


def test_a_hand_leads_in_one_program_only_and_an_arm_of_as_many_joints() -> None:
    hand = HandPath.random(robots.load("irb120"), 0)
    scene = Surroundings(hand=hand)
    assert scene.leads("loop", 7) is None
    assert scene.leads("lead-through", 6) is hand
    with pytest.raises(ShapeError, match="7 joints, got a path of 6"):
        scene.leads("lead-through", 7)


def test_hands_that_push_and_hold_add_up() -> None:
    push = AppliedWrench(np.array([0.0, 3.0]), np.tile([1.0, 0, 0, 0, 0, 0], (2, 1)))
    scene, moved = Surroundings(push, grip=Grip(1.0, 2.0)), np.eye(4)
    moved[0, 3] = 0.001
    np.testing.assert_array_equal(scene.wrench(0.5, np.eye(4)), [1, 0, 0, 0, 0, 0])
    np.testing.assert_array_equal(scene.wrench(1.0, np.eye(4)), [1, 0, 0, 0, 0, 0])
    held = scene.wrench(1.5, moved)
    assert held[0] < 1.0
    assert Surroundings().wrench(1.0, np.eye(4)) is None
    assert Surroundings(grip=Grip(0.0, 1.0)).wrench(0.5, np.eye(4)) is not None


def test_linear_between_rows_and_nothing_outside() -> None:
    wrench = np.zeros((3, 6))
    wrench[1] = [5, 0, 0, 0, 0.5, 0]
    operator = AppliedWrench(np.array([1.0, 1.5, 3.0]), wrench)
    assert operator.at(0.999) is None
    assert operator.at(3.001) is None
    np.testing.assert_allclose(operator.at(1.25), [2.5, 0, 0, 0, 0.25, 0])
    np.testing.assert_allclose(operator.at(1.5), wrench[1])
    np.testing.assert_allclose(operator.at(2.25), [2.5, 0, 0, 0, 0.25, 0])
    np.testing.assert_allclose(operator.at(1.0), wrench[0])
    np.testing.assert_allclose(operator.at(3.0), wrench[2])


def pose(p: list[float], w: list[float]) -> np.ndarray:
    return se3.from_rp(so3.exp(np.array(w)), np.array(p))


def test_it_holds_the_tool_where_it_took_it() -> None:
    grip, start = Grip(1.0, 2.0), pose([0.4, 0.1, 0.3], [0.2, -0.1, 0.5])
    assert grip.at(0.999, pose([0.0, 0.0, 0.0], [0.0, 0.0, 0.0])) is None
    np.testing.assert_array_equal(grip.at(1.0, start), np.zeros(6))
    moved = start.copy()
    moved[:3, 3] += [0.01, 0.0, -0.02]
    np.testing.assert_allclose(
        grip.at(1.1, moved), -STIFFNESS * [0.01, 0, -0.02, 0, 0, 0] - DAMPING * [0.1, 0, -0.2, 0, 0, 0]
    )
    turned = start.copy()
    turned[:3, :3] = so3.exp(np.array([0.0, 0.0, 0.1])) @ start[:3, :3]
    wrench = grip.at(1.2, turned)
    assert wrench[5] == pytest.approx(-15 * 0.1 - 1.0 * 1.0)
    assert grip.at(2.0, start) is None


def test_it_is_only_so_strong() -> None:
    grip, start = Grip(0.0, 2.0), pose([0.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    grip.at(0.0, start)
    np.testing.assert_array_equal(np.abs(grip.at(1.0, pose([1.0, -1.0, 1.0], [1.0, -1.0, 1.0]))), STRENGTH)


ROBOT = robots.load("yumi_right")


@pytest.mark.parametrize("seed", [0, 3])
def test_random_paths_are_smooth_and_inside(seed: int) -> None:
    path = HandPath.random(ROBOT, seed, 20.0)
    t = np.arange(0.0, 20.0, 0.004)
    q, qd = (np.array(values) for values in zip(*(path.at(at) for at in t)))
    assert ((q >= ROBOT.q_min) & (q <= ROBOT.q_max)).all()
    assert (np.abs(qd) <= 0.11 * ROBOT.qd_max).all()
    assert np.abs(np.diff(qd, axis=0)).max() < 0.02, "no steps of the speed"
    np.testing.assert_allclose(np.diff(q, axis=0) / 0.004, (qd[1:] + qd[:-1]) / 2, atol=2e-3)
    np.testing.assert_allclose(q[0], ROBOT.q_home)
    assert np.ptp(q, axis=0).max() > 0.1
    np.testing.assert_array_equal(path.at(7.0)[0], HandPath.random(ROBOT, seed, 20.0).at(7.0)[0])


def test_rows_are_met_and_it_rests_outside() -> None:
    path = HandPath(np.array([1.0, 2.0, 4.0]), np.array([[0.0], [1.0], [0.5]]))
    assert path.n == 1
    assert [float(path.at(t)[0][0]) for t in (0.0, 1.0, 2.0, 4.0, 9.0)] == [0.0, 0.0, 1.0, 0.5, 0.5]
    assert path.at(0.5)[1][0] == path.at(5.0)[1][0] == 0.0


def test_states_over_time() -> None:
    script = StateScript("0:on,2.5:off,4:on", MOTORS)
    assert [script.at(t) for t in (-1.0, 0.0, 2.4, 2.5, 3.9, 4.0, 99.0)] == [1, 1, 1, 2, 2, 1, 1]
    assert StateScript("undefined", RAPID).at(5.0) == 0
