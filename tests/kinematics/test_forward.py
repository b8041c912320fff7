"""Forward kinematics, Jacobians and their derivatives."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest

from armlab import robots
from armlab.kinematics import forward, forward_jacobian, jacobian, link_transforms, parameter_jacobian
from armlab.lie import se3, so3


def test_link_transforms_lead_to_the_tool() -> None:
    robot, q = robots.load("yumi_right"), np.arange(1, 8) / 10
    T_base_link = link_transforms(robot, q)
    assert T_base_link.shape == (7, 4, 4)
    np.testing.assert_allclose(T_base_link[-1] @ robot.frames[-1], forward(robot, q), rtol=0, atol=1e-15)


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


@pytest.fixture(params=["irb2400", "sliding"])
def robot_parameters(request: pytest.FixtureRequest) -> robots.Robot:
    arm = robots.load("irb2400")
    if request.param == "sliding":
        arm = replace(arm, prismatic=np.array([0, 0, 1, 0, 0, 0]), coupling=np.eye(6))
    return arm


def moved(arm: robots.Robot, j: int, twist: np.ndarray) -> robots.Robot:
    links = np.array(arm.links)
    links[j] = links[j] @ se3.exp(twist)
    return replace(arm, links=links)


@pytest.mark.parametrize("shape", [(), (4,), (2, 3)])
def test_columns_are_differences(robot_parameters: robots.Robot, shape: tuple[int, ...]) -> None:
    q = np.random.default_rng(0).uniform(-1, 1, (*shape, 6))
    J = parameter_jacobian(robot_parameters, q)
    assert J.shape == (*shape, 6, 7, 6)
    for j in range(6):  # the last link is followed by the tool, which is the identity here
        for k in range(6):
            step = 1e-6 * np.eye(6)[k]
            up, down = forward(moved(robot_parameters, j, step), q), forward(moved(robot_parameters, j, -step), q)
            v = (up - down)[..., :3, 3] / 2e-6
            w = so3.log(up[..., :3, :3] @ np.swapaxes(down[..., :3, :3], -1, -2)) / 2e-6
            np.testing.assert_allclose(J[..., :3, j, k], v, rtol=0, atol=1e-8)
            np.testing.assert_allclose(J[..., 3:, j, k], w, rtol=0, atol=1e-8)


def test_joints_are_the_z_axes_of_the_frames(robot_parameters: robots.Robot) -> None:
    q = np.random.default_rng(1).uniform(-1, 1, (5, 6))
    own = parameter_jacobian(robot_parameters, q)[..., np.arange(6), np.where(robot_parameters.prismatic, 2, 5)]
    np.testing.assert_allclose(own, jacobian(robot_parameters, q), rtol=0, atol=1e-14)
