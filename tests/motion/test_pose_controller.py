"""A primitive of poses leads the tool of an arm: along its path, to another goal, and not where the arm cannot be."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from armlab import Command, State, robots
from armlab.errors import ShapeError
from armlab.kinematics import forward, inverse
from armlab.lie import se3, so3
from armlab.motion import PoseDmp, fit_pose_dmp
from armlab.motion.control import Controller
from armlab.motion.pose_dmp import PoseDmpController

PERIOD = 0.004032
ROBOT = robots.load("yumi_right")
START = forward(ROBOT, ROBOT.q_home)


@pytest.fixture(scope="module")
def path() -> PoseDmp:
    """A second and a half: 0.1 m along y and up, turned by 0.4 rad."""
    u = np.linspace(0.0, 1.0, 301)
    s = 10 * u**3 - 15 * u**4 + 6 * u**5
    T = np.tile(START, (301, 1, 1))
    T[:, :3, 3] += np.outer(s, [0.0, 0.1, 0.05]) + np.outer(np.sin(np.pi * s), [0.0, 0.0, 0.02])
    T[:, :3, :3] = so3.exp(np.outer(s, [0.0, 0.0, 0.4])) @ START[:3, :3]
    return fit_pose_dmp(1.5 * u, T).value


def run(controller: Controller, seconds: float, q: np.ndarray = ROBOT.q_home) -> np.ndarray:
    """Joint positions of an arm that is where it was told to be one packet ago."""
    found, qd = [q], np.zeros(7)
    for k in range(round(seconds / PERIOD)):
        command: Command = controller(State(k * PERIOD, PERIOD, found[-1], qd, found[-1]))
        if command.ends:
            break
        assert command.q is not None
        assert command.qd is not None
        found.append(command.q)
        qd = command.qd
    return np.array(found[1:])


def test_the_tool_goes_along_the_path(path: PoseDmp) -> None:
    controller = path.controller(ROBOT)
    assert isinstance(controller, PoseDmpController)
    q = run(controller, 2.2)
    wanted = path.rollout(PERIOD * np.arange(len(q)), start=START, twist0=np.zeros(6)).T
    apart = se3.log(se3.inv(forward(ROBOT, q)) @ wanted)
    assert np.abs(apart).max() < 1e-6
    assert np.abs(np.diff(q, axis=0)).max() < 0.02
    assert controller.done


def test_it_is_not_done_where_the_tool_is_turned_and_says_how_the_joints_accelerate(path: PoseDmp) -> None:
    controller, q, qd, told = path.controller(ROBOT), ROBOT.q_home, np.zeros(7), []
    for k in range(400):
        command = controller(State(k * PERIOD, PERIOD, q, qd, q))
        assert command.q is not None
        assert command.qd is not None
        assert command.record is not None
        q, qd = command.q, command.qd
        told.append((q, command.record["qdd_ref"]))
    joints, qdd = (np.array(part) for part in zip(*told))
    np.testing.assert_allclose(qdd[2:], np.diff(joints, 2, axis=0) / PERIOD**2, rtol=0, atol=1e-6)
    goal = path.T_goal.copy()
    for angle, done in ((0.02, False), (0.0, True)):
        goal[:3, :3] = so3.exp([0.0, angle, 0.0]) @ path.T_goal[:3, :3]
        there = inverse(ROBOT, goal, q).q
        for k in range(60):
            controller(State(2.0 + k * PERIOD, PERIOD, there, np.zeros(7), there))
        assert controller.done is done


def test_from_elsewhere_and_to_another_goal(path: PoseDmp) -> None:
    controller = path.controller(ROBOT, duration=2.0)
    q = run(controller, 0.8, ROBOT.q_home + 0.03)
    goal = path.T_goal.copy()
    goal[:3, 3] += [0.02, 0.0, -0.02]
    controller.goal = goal
    state = State(0.8, PERIOD, q[-1], np.zeros(7), q[-1])
    before = q[-1]
    assert np.abs(controller(state).q - before).max() < 0.02
    q = run(controller, 2.5, q[-1])
    np.testing.assert_allclose(forward(ROBOT, q[-1]), goal, atol=5e-3)
    assert controller.done
    np.testing.assert_allclose(controller.goal, goal, atol=1e-12)


def test_a_goal_out_of_reach_gets_a_sentence(path: PoseDmp) -> None:
    far = path.T_goal.copy()
    far[:3, 3] += [0.0, 0.0, 3.0]
    with pytest.raises(ShapeError, match=r"^Expected a goal that yumi_right reaches .*\.$"):
        path.controller(ROBOT, goal=far)
    with pytest.raises(ShapeError, match=r"^Expected goal as a pose"):
        path.controller(ROBOT, goal=np.zeros(3))


def test_a_path_that_the_arm_leaves_ends_the_run(path: PoseDmp) -> None:
    controller = path.controller(ROBOT)
    run(controller, 0.2)

    controller._stepper.change_goal(_lifted(path.T_goal, 30.0))  # pyright: ignore
    run(controller, 3.0)
    assert controller.reason.startswith("Expected a path that yumi_right reaches")


def _lifted(T: np.ndarray, height: float) -> np.ndarray:
    lifted = T.copy()
    lifted[2, 3] += height
    return lifted


def test_calls_leave_nothing_behind(path: PoseDmp, kept: Callable[..., tuple[int, int]]) -> None:
    blocks, peak = kept(path.controller(ROBOT), ROBOT.q_home, PERIOD)
    assert blocks < 20  # of a thousand calls
    assert peak < 20_000  # bytes at any time of them: a reference and its record
