"""Poses sample by sample: the same numbers as a rollout, and a goal that changes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab.errors import ConfigError, ShapeError
from armlab.estimation import Fit
from armlab.lie import so3
from armlab.motion import PoseDmp, PoseStepper, fit_pose_dmp


@pytest.mark.parametrize("frame", ["base", "goal"])
def test_steps_are_the_rollout(pose_fit: Fit[PoseDmp], frame: str) -> None:
    dmp, t = replace(pose_fit.value, frame=frame), np.cumsum(np.random.default_rng(0).uniform(0.001, 0.006, 100))
    goal = dmp.T_goal.copy()
    goal[:3, :3] = so3.exp([0.2, 0, 0.3]) @ goal[:3, :3]
    run = dmp.rollout(t, goal=goal, duration=0.5)
    stepper = dmp.stepper(goal=goal, duration=0.5)
    assert isinstance(stepper, PoseStepper)
    for _ in range(2):
        rows = [stepper.state, *(stepper.step(dt) for dt in np.diff(t))]
        for own, wanted in zip(map(np.array, zip(*rows)), (run.T, run.twist, run.twistd)):
            np.testing.assert_allclose(own, wanted, rtol=0, atol=1e-12 * (1 + np.abs(wanted).max()))
        stepper.reset()


def test_a_goal_that_changes_is_reached_without_a_jump(pose_fit: Fit[PoseDmp]) -> None:
    stepper = pose_fit.value.stepper()
    for _ in range(100):
        T, twist, _ = stepper.step(0.004)
    goal = T.copy()
    goal[:3, :3], goal[:3, 3] = so3.exp([0, 0.6, 0]) @ T[:3, :3], T[:3, 3] + [0.1, 0, -0.1]
    stepper.change_goal(goal)
    np.testing.assert_array_equal(stepper.state[0], T)
    np.testing.assert_array_equal(stepper.state[1], twist)
    for _ in range(2000):
        T, twist, _ = stepper.step(0.004)
    np.testing.assert_allclose(T, goal, rtol=0, atol=1e-9)


def test_refusals(pose_fit: Fit[PoseDmp], pose_demo: tuple[np.ndarray, np.ndarray]) -> None:
    stepper = pose_fit.value.stepper()
    with pytest.raises(ShapeError, match="dt above zero"):
        stepper.step(0.0)
    with pytest.raises(ShapeError, match="goal as a pose"):
        stepper.change_goal(np.eye(3))
    with pytest.raises(ConfigError, match="base axes"):
        replace(pose_fit.value, frame="goal").stepper().change_goal(np.eye(4))
    with pytest.raises(ConfigError, match="rotate"):
        fit_pose_dmp(*pose_demo, n_basis=8, scaling="rotate").value.stepper().change_goal(pose_demo[1][125])
