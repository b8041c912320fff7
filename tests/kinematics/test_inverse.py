"""Inverse kinematics: exact inside the limits, quick, deterministic, and honest about what it cannot do."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from armlab import lie, robots
from armlab.errors import ConfigError, NotConverged, ShapeError, UnknownName
from armlab.kinematics import Inverse, forward, inverse, jacobian
from armlab.robots import Robot

ARMS = ["yumi_left", "irb2400", "irb7600", "ur5e"]


def reachable(robot: Robot, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Postures uniform inside the limits, and their poses."""
    q = np.random.default_rng(seed).uniform(robot.q_min, robot.q_max, (count, robot.n))
    return q, forward(robot, q)


def errors(robot: Robot, q: np.ndarray, T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance and angle from the tool to the goals, not by the solver's own account."""
    found = forward(robot, q)
    return np.linalg.norm(found[..., :3, 3] - T[..., :3, 3], axis=-1), lie.so3.angle(found[..., :3, :3], T[..., :3, :3])


def inside(robot: Robot, q: np.ndarray) -> bool:
    return bool(np.all((robot.q_min <= q) & (q <= robot.q_max)))


def solved(robot: Robot, count: int, seed: int) -> float:
    """Part of random reachable poses that are solved to 1e-9 inside the limits; the solver's word for it is checked."""
    _, T = reachable(robot, count, seed)
    result = inverse(robot, T)
    position, rotation = errors(robot, result.q, T)
    assert inside(robot, result.q)
    exact = (position <= 1e-9 + 1e-15) & (rotation <= 1e-9 + 1e-15)
    np.testing.assert_array_equal(exact, result.success)
    np.testing.assert_allclose(result.position_error, position, rtol=0, atol=1e-14)
    np.testing.assert_allclose(result.rotation_error, rotation, rtol=0, atol=1e-14)
    return float(np.mean(exact))


@pytest.mark.parametrize("name", ARMS)
def test_random_reachable_poses_are_solved_from_random_starts(name: str) -> None:
    assert solved(robots.load(name), 500, seed=1) >= 0.998  # one of 500


def test_numeric_example_of_the_ancestor() -> None:
    """IRB 7600 from q = 1, goal moved by (0.1, 0.1, 0.1) m in base axes, then turned by 1 degree about its z axis."""
    robot = robots.load("irb7600").with_base(np.eye(4)).with_tool(np.eye(4))
    T = forward(robot, np.ones(6))
    T[:3, 3] += 0.1
    T[:3, :3] = T[:3, :3] @ lie.euler.rot_z(np.deg2rad(1.0))
    found = inverse(robot, T, np.ones(6), starts=1)
    wanted = (0.974117541152, 0.837125380334, 0.930496390320, 0.868829972477, 1.132254977044, 1.236310321013)
    assert found.success
    np.testing.assert_allclose(found.q, wanted, rtol=0, atol=2e-9)
    assert found.iterations <= 6


def test_a_batch_is_a_loop() -> None:
    robot = robots.load("yumi_right")
    q, T = reachable(robot, 12, seed=2)
    T[5, :3, 3] += 5.0
    batch = inverse(robot, T.reshape(3, 4, 4, 4), (q + 0.05).reshape(3, 4, 7), threads=2)
    assert batch.q.shape == (3, 4, 7)
    for k in range(12):
        one = inverse(robot, T[k], q[k] + 0.05)
        for name in ("q", "success", "position_error", "rotation_error", "iterations", "starts", "reason"):
            np.testing.assert_array_equal(getattr(batch, name)[k // 4, k % 4], getattr(one, name))


@pytest.mark.parametrize("name", ["yumi_left", "yumi_right"])
def test_the_recipe_for_get_kinematic_functions(name: str) -> None:
    """One line gives the ancestor's three functions; inverse of forward is the posture it starts from."""
    fkine, jac, ikine = (partial(f, robots.load(name)) for f in (forward, jacobian, inverse))
    q = np.array([-0.3, -1.2, 0.7, 0.4, 1.0, 0.5, -0.2])
    assert jac(q).shape == (6, 7)
    found = ikine(fkine(q), q)
    np.testing.assert_array_equal(found.q, q)
    assert found.iterations == 0


def test_no_goals() -> None:
    robot = robots.load("irb2400")
    result = inverse(robot, np.empty((0, 4, 4)))
    assert result.q.shape == (0, 6)
    assert result.success.shape == (0,)
    assert result.report() == "0 of 0 goals solved."


def test_unknown_task() -> None:
    with pytest.raises(UnknownName, match=r"inverse task, got 'wrist'. Known: axis, direction, pose, position"):
        inverse(robots.load("irb2400"), np.eye(4), task="wrist")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("arguments", "error", "sentence"),
    [
        ({"T_base_tool": np.eye(3)}, ShapeError, r"T_base_tool of shape \(\.\.\., 4, 4\), got \(3, 3\)"),
        ({"T_base_tool": np.eye(4) * np.nan}, ShapeError, "finite poses .* got T_base_tool that is not"),
        ({"q0": np.zeros(5)}, ShapeError, r"q0 of shape \(6,\) or one posture per goal"),
        ({"q0": np.full(6, np.nan)}, ShapeError, "finite joint positions, got others in q0"),
        ({"seed": -1}, ConfigError, r"seed to be an integer from 0 to 2\^64 - 1, got -1"),
        ({"threads": 0}, ConfigError, "threads to be an integer from 1"),
        ({"task": "axis", "axis": (0, 0, 0)}, ShapeError, "a direction in tool axes"),
    ],
)
def test_wrong_arguments(arguments: dict, error: type[Exception], sentence: str) -> None:
    with pytest.raises(error, match=sentence):
        inverse(robots.load("irb2400"), **({"T_base_tool": np.eye(4)} | arguments))


def test_strict_raises_with_the_result() -> None:
    robot = robots.load("irb2400")
    T = forward(robot, robot.q_home)
    T[0, 3] += 10.0
    with pytest.raises(NotConverged, match="out of reach") as caught:
        inverse(robot, T, strict=True)
    assert isinstance(caught.value.best, Inverse)
    assert caught.value.best.reason == "out of reach"
