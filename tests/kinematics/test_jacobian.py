"""The Jacobian of the library robots: published reference numbers, derivative, frames."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest

from armlab import lie, robots
from armlab.errors import ConfigError, ShapeError, UnknownName
from armlab.kinematics import forward, forward_jacobian, jacobian

RAMP = np.arange(1, 8) / 10

# Flange, without mount and tool: robot, q, J times a vector of ones (base axes, tool point).
REFERENCE = [
    ("irb2400", np.zeros(6), (0.975, 0.94, -1.765, 2, 3, 1)),
    (
        "irb2400",
        np.ones(6),
        (-1.065199851629, -0.687568621463, -0.051544723256, -2.889699298619, 1.511704837576, -0.561567787807),
    ),
    (
        "irb2400",
        RAMP[:6],
        (-0.118314250945, 1.074968536053, -1.716423864621, 1.304361026368, 3.254234528159, 0.054062664636),
    ),
    ("irb7600", np.zeros(6), (1.405, 1.716, -2.862, 2, 3, 1)),
    (
        "irb7600",
        RAMP[:6],
        (-0.494523405289, 1.925092727513, -2.583373807096, 1.304361026368, 3.254234528159, 0.054062664636),
    ),
    ("yumi_left", np.zeros(7), (0.3815, 0.6615, -0.6965, 2, 3, 2)),
    (
        "yumi_right",
        np.ones(7),
        (-0.332963909040, -0.579088957297, 0.146185385520, -3.092758901510, 1.085560310987, 2.018584811360),
    ),
    (
        "yumi_left",
        RAMP,
        (-0.349855990704, 0.628741526053, -0.652366329789, 0.641429313372, 3.629494786012, 1.077111066362),
    ),
]


@pytest.mark.parametrize(("name", "q", "sums"), REFERENCE)
def test_jacobian_gives_the_reference_numbers(name: str, q: np.ndarray, sums: tuple) -> None:
    robot = robots.load(name).with_base(np.eye(4)).with_tool(np.eye(4))
    np.testing.assert_allclose(jacobian(robot, q).sum(axis=1), sums, rtol=0, atol=1e-11)


@pytest.mark.parametrize("name", robots.names())
def test_jacobian_is_the_derivative_of_forward(name: str) -> None:
    """Columns are log(T(q + h) T(q - h)^-1) / 2h: turn as it is, shift at the tool point."""
    robot, h = robots.load(name), 2e-5
    q = np.random.default_rng(1).uniform(-2, 2, robot.n)
    plus, minus = forward(robot, q + h * np.eye(robot.n)), forward(robot, q - h * np.eye(robot.n))
    v = plus[:, :3, 3] - minus[:, :3, 3]
    w = lie.so3.log(plus[:, :3, :3] @ np.swapaxes(minus[:, :3, :3], 1, 2))
    np.testing.assert_allclose(jacobian(robot, q), np.concatenate([v, w], axis=1).T / (2 * h), rtol=0, atol=1e-8)


def test_tool_frame_turns_both_halves() -> None:
    robot = robots.load("yumi_left")
    q = np.random.default_rng(2).uniform(robot.q_min, robot.q_max, (4, 7))
    R = forward(robot, q)[:, :3, :3]
    J, J_tool = jacobian(robot, q), jacobian(robot, q, frame="tool")
    for half in (slice(0, 3), slice(3, 6)):
        np.testing.assert_allclose(R @ J_tool[:, half], J[:, half], rtol=0, atol=1e-14)


def test_there_is_no_third_frame() -> None:
    robot = robots.load("irb2400")
    with pytest.raises(UnknownName, match=r"Jacobian frame, got 'world'. Known: base, tool"):
        jacobian(robot, np.zeros(6), frame="world")  # type: ignore[arg-type]


def test_out_is_filled() -> None:
    robot, out = robots.load("irb2400"), np.empty((2, 6, 6))
    assert jacobian(robot, np.ones((2, 6)), out=out) is out
    np.testing.assert_array_equal(out[1], jacobian(robot, np.ones(6)))


@pytest.mark.parametrize("frame", ["base", "tool"])
def test_pose_and_jacobian_in_one_call(frame: Literal["base", "tool"]) -> None:
    robot = robots.load("yumi_right")
    q = np.random.default_rng(3).uniform(robot.q_min, robot.q_max, (9000, 7))
    T, J = forward_jacobian(robot, q, frame=frame)
    np.testing.assert_array_equal(T, forward(robot, q))
    np.testing.assert_array_equal(J, jacobian(robot, q, frame=frame))
    out = np.empty_like(T), np.empty_like(J)
    shared = forward_jacobian(robot, q, frame, out, threads=2)
    assert shared[0] is out[0]
    assert shared[1] is out[1]
    np.testing.assert_array_equal(out[0], T)
    np.testing.assert_array_equal(out[1], J)
    np.testing.assert_array_equal(jacobian(robot, q, frame, threads=2), J)


def test_pose_and_jacobian_refuse() -> None:
    robot, q = robots.load("irb2400"), np.zeros((2, 6))
    with pytest.raises(UnknownName, match=r"Jacobian frame, got 'world'. Known: base, tool"):
        forward_jacobian(robot, q, frame="world")  # type: ignore[arg-type]
    with pytest.raises(ShapeError, match=r"out to be a pair of arrays \(T, J\)"):
        forward_jacobian(robot, q, out=np.empty((2, 4, 4)))  # type: ignore[arg-type]
    with pytest.raises(ShapeError, match=r"q of shape \(\.\.\., 6\), got \(7,\)"):
        forward_jacobian(robot, np.zeros(7))
    with pytest.raises(ConfigError, match=r"Expected threads to be an integer from 1 to 256, got 2\.5\."):
        jacobian(robot, q, threads=2.5)  # type: ignore[arg-type]
