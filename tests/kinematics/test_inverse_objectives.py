"""Inverse kinematics of redundant arms: the pose stays exact while the free joints make an objective least."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import robots
from armlab.kinematics import forward, inverse, jacobian, manipulability, manipulability_gradient
from armlab.robots import Robot

COUNT = 300
OBJECTIVES = ("posture", "mid_range", "limits", "manipulability")
ROWS = {"pose": slice(0, 6), "position": slice(0, 3)}
YUMI = "yumi_left"


def goals(robot: Robot, count: int, seed: int) -> np.ndarray:
    return forward(robot, np.random.default_rng(seed).uniform(robot.q_min, robot.q_max, (count, robot.n)))


def scaled(robot: Robot, q: np.ndarray) -> np.ndarray:
    """Joint positions as -1 to 1 from limit to limit."""
    return (2.0 * q - robot.q_max - robot.q_min) / (robot.q_max - robot.q_min)


def gradient(robot: Robot, q: np.ndarray, objective: str, task: str) -> np.ndarray:
    """Gradients (N, n) as the documentation of `inverse` defines the objectives, written down once more."""
    x, slope = scaled(robot, q), 2.0 / (robot.q_max - robot.q_min)
    if objective == "posture":
        return q - robot.q_home
    if objective == "mid_range":
        return slope * x
    if objective == "limits":
        largest = np.abs(x).max(axis=1, keepdims=True)
        up, down = np.exp(1000.0 * (x - largest)), np.exp(1000.0 * (-x - largest))
        return slope * ((up - down) / (up + down).sum(axis=1, keepdims=True) + 1e-3 * x)
    w = manipulability(robot, q, task)  # type: ignore[arg-type]
    return -manipulability_gradient(robot, q, task) / w[:, None]  # type: ignore[arg-type]


def left_slope(robot: Robot, q: np.ndarray, g: np.ndarray, rows: slice) -> float:
    """Slope along the self-motion of the joints that are not pressed against a limit, by singular vectors."""
    free = np.ones(robot.n, dtype=bool)
    for _ in range(robot.n):
        J = jacobian(robot, q)[rows][:, free]
        null = np.linalg.svd(J)[2][J.shape[0] :]
        along = np.zeros(robot.n)
        along[free] = null.T @ (null @ g[free])
        pressed = free & (((q >= robot.q_max) & (along < 0)) | ((q <= robot.q_min) & (along > 0)))
        if not pressed.any():
            return float(np.linalg.norm(along))
        free &= ~pressed
    return 0.0


@pytest.mark.parametrize("objective", OBJECTIVES)
@pytest.mark.parametrize("task", ["pose", "position"])
def test_pose_is_exact_and_no_slope_is_left(objective: str, task: str) -> None:
    robot = robots.load(YUMI)
    T = goals(robot, COUNT, seed=1)
    result = inverse(robot, T, task=task, objective=objective)  # type: ignore[arg-type]
    assert result.success.all()
    assert ((robot.q_min <= result.q) & (result.q <= robot.q_max)).all()
    assert result.position_error.max() <= 1e-9
    assert task == "position" or result.rotation_error.max() <= 1e-9
    g = gradient(robot, result.q, objective, task)
    left = np.array([left_slope(robot, *row, ROWS[task]) for row in zip(result.q, g)])
    assert left.max() <= 1e-6
    assert result.slope.max() <= 1e-6
    at_limit = ((result.q == robot.q_min) | (result.q == robot.q_max)).any(axis=1)
    assert at_limit.mean() < 0.7  # the others had to come to rest


def test_objectives_are_better_than_the_plain_solution() -> None:
    robot = robots.load(YUMI)
    T = goals(robot, COUNT, seed=2)
    plain = inverse(robot, T)
    assert np.isnan(plain.slope).all()
    away = [np.linalg.norm(q - robot.q_home, axis=1) for q in (inverse(robot, T, objective="posture").q, plain.q)]
    assert np.all(away[0] <= away[1] + 1e-9)
    middle = [np.linalg.norm(scaled(robot, q), axis=1) for q in (inverse(robot, T, objective="mid_range").q, plain.q)]
    assert np.all(middle[0] <= middle[1] + 1e-9)
    w = [manipulability(robot, q) for q in (inverse(robot, T, objective="manipulability").q, plain.q)]
    assert np.all(w[0] >= w[1] * (1 - 1e-6) - 1e-9)
    assert np.mean(w[0]) > 1.1 * np.mean(w[1])


@pytest.mark.parametrize("name", [YUMI, "panda", "iiwa14"])
def test_limits_are_avoided(name: str) -> None:
    """On 99 % of the poses the smallest distance to a limit, over the range, is at least that of the plain solution."""
    robot = robots.load(name)
    T = goals(robot, 1000, seed=3)
    near = [np.abs(scaled(robot, inverse(robot, T, objective=o).q)).max(axis=1) for o in ("limits", None)]
    assert np.mean(near[0] <= near[1] + 1e-9) >= 0.99
    assert np.median(near[1] - near[0]) > 0.02


def test_the_posture_that_is_asked_for() -> None:
    """By default where the search starts; one for all goals, or one per goal."""
    robot = robots.load(YUMI)
    rng = np.random.default_rng(4)
    q = rng.uniform(0.8 * robot.q_min, 0.8 * robot.q_max, (20, 7))
    T = forward(robot, q)
    near = q + rng.uniform(-0.05, 0.05, q.shape)
    each = inverse(robot, T, near, objective="posture")
    np.testing.assert_array_equal(each.q, inverse(robot, T, near, objective="posture", posture=near).q)
    assert np.all(np.linalg.norm(each.q - near, axis=1) <= np.linalg.norm(q - near, axis=1) + 1e-9)
    np.testing.assert_array_equal(
        inverse(robot, T, objective="posture").q, inverse(robot, T, objective="posture", posture=robot.q_home).q
    )
    same = inverse(robot, T, q, objective="posture", posture=q)
    np.testing.assert_allclose(same.q, q, rtol=0, atol=1e-12)


def test_without_freedom_an_objective_changes_nothing() -> None:
    robot = robots.load("irb2400")
    T = goals(robot, 20, seed=5)
    result = inverse(robot, T, objective="mid_range")
    np.testing.assert_allclose(result.q, inverse(robot, T).q, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(result.slope, 0.0)


def test_five_of_six_joints_for_an_axis() -> None:
    """A tool that may turn about its axis is a redundant task on six joints."""
    robot = robots.load("irb2400")
    T = goals(robot, 50, seed=6)
    result = inverse(robot, T, task="axis", objective="limits")
    assert result.success.all()
    assert result.slope.max() <= 1e-6
    turned = forward(robot, result.q)
    np.testing.assert_allclose(turned[:, :3, 2:], T[:, :3, 2:], rtol=0, atol=2e-9)
    assert np.abs(turned[:, :3, 0] - T[:, :3, 0]).max() > 0.1


def test_joints_without_limits_have_no_middle() -> None:
    zeros = np.zeros(4)
    robot = robots.from_dh("planar", zeros, np.ones(4), zeros, zeros, q_min=(-3, -np.inf, -2, -1), q_max=(3, 3, 2, 1))
    T = forward(robot, (0.3, 0.4, -0.5, 0.6))
    result = inverse(robot, T, task="position", objective="limits")
    assert result.success
    assert result.slope <= 1e-6
