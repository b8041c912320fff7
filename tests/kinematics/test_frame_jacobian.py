"""How the tool moves with the constant frames of an arm: against differences and the Jacobian of the joints."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab import robots
from armlab.errors import RobotError, ShapeError
from armlab.kinematics import forward, frame_jacobian, frame_poses, jacobian, link_transforms, twist_jacobian
from armlab.lie import se3, so3


@pytest.fixture(params=["irb2400", "sliding"])
def robot(request: pytest.FixtureRequest) -> robots.Robot:
    arm = robots.load("irb2400")
    if request.param == "sliding":
        arm = replace(arm, prismatic=np.array([0, 0, 1, 0, 0, 0]), coupling=np.eye(6))
    return arm


def moved(arm: robots.Robot, j: int, twist: np.ndarray) -> robots.Robot:
    links = np.array(arm.links)
    links[j] = links[j] @ se3.exp(twist)
    return replace(arm, links=links)


@pytest.mark.parametrize("shape", [(), (4,), (2, 3)])
def test_columns_are_differences(robot: robots.Robot, shape: tuple[int, ...]) -> None:
    q = np.random.default_rng(0).uniform(-1, 1, (*shape, 6))
    J = frame_jacobian(robot, q)
    assert J.shape == (*shape, 6, 7, 6)
    for j in range(6):  # the last link is followed by the tool, which is the identity here
        for k in range(6):
            step = 1e-6 * np.eye(6)[k]
            up, down = forward(moved(robot, j, step), q), forward(moved(robot, j, -step), q)
            v = (up - down)[..., :3, 3] / 2e-6
            w = so3.log(up[..., :3, :3] @ np.swapaxes(down[..., :3, :3], -1, -2)) / 2e-6
            np.testing.assert_allclose(J[..., :3, j, k], v, rtol=0, atol=1e-8)
            np.testing.assert_allclose(J[..., 3:, j, k], w, rtol=0, atol=1e-8)


def test_joints_are_the_z_axes_of_the_frames(robot: robots.Robot) -> None:
    q = np.random.default_rng(1).uniform(-1, 1, (5, 6))
    own = frame_jacobian(robot, q)[..., np.arange(6), np.where(robot.prismatic, 2, 5)]
    np.testing.assert_allclose(own, jacobian(robot, q), rtol=0, atol=1e-14)


def test_poses_are_links_before_their_joints_turn(robot: robots.Robot) -> None:
    q = np.random.default_rng(2).uniform(-1, 1, (5, 6))
    P = frame_poses(robot.chain, robot.frames, q)
    np.testing.assert_allclose(P[:, -1], forward(robot, q), rtol=0, atol=1e-14)
    first = np.zeros_like(q)
    first[:, 1:] = q[:, 1:]
    np.testing.assert_allclose(P[:, 0], link_transforms(robot, first)[:, 0], rtol=0, atol=1e-14)


def test_any_point_moves_with_a_frame() -> None:
    rng = np.random.default_rng(3)
    P, point, twist = (
        se3.exp(rng.standard_normal((4, 2, 6))),
        rng.standard_normal((4, 3)),
        1e-6 * rng.standard_normal(6),
    )
    J = twist_jacobian(P, point)
    for j in range(2):
        step = P[:, j] @ se3.exp(twist) @ se3.inv(P[:, j])
        after = np.einsum("iab,ib->ia", step[:, :3, :3], point) + step[:, :3, 3]
        np.testing.assert_allclose(J[:, :3, j] @ twist, after - point, rtol=0, atol=1e-11)
        np.testing.assert_allclose(J[:, 3:, j] @ twist, so3.log(step[:, :3, :3]), rtol=0, atol=1e-11)


def test_sentences() -> None:
    with pytest.raises(RobotError, match="Load it first"):
        frame_jacobian("irb2400", np.zeros(6))  # type: ignore[arg-type]
    with pytest.raises(ShapeError):
        frame_jacobian(robots.load("irb2400"), np.zeros(5))
