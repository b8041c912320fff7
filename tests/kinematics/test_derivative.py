"""The time derivative of the Jacobian: central differences, Pinocchio, the circle, frames."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.errors import ShapeError, UnknownName
from armlab.kinematics import forward, jacobian, jacobian_derivative
from armlab.robots import Robot


def sliding(robot: Robot) -> Robot:
    """The same links, but the second and the fifth joint slide."""
    return replace(robot, prismatic=np.isin(np.arange(robot.n), (1, 4)))


@pytest.fixture(params=[*robots.names(), "sliding"])
def robot(request: pytest.FixtureRequest) -> Robot:
    return sliding(robots.load("irb2400")) if request.param == "sliding" else robots.load(request.param)


@pytest.mark.parametrize("frame", ["base", "tool"])
def test_it_is_the_derivative_of_the_jacobian(robot: Robot, frame: Any) -> None:
    rng, h = np.random.default_rng(1), 2e-5
    q, qd = rng.uniform(-2, 2, (2, 5, robot.n))
    change = jacobian(robot, q + h * qd, frame) - jacobian(robot, q - h * qd, frame)
    np.testing.assert_allclose(jacobian_derivative(robot, q, qd, frame), change / (2 * h), rtol=0, atol=1e-8)


@pytest.mark.parametrize("frame", ["base", "tool"])
def test_pinocchio_agrees(robot: Robot, frame: str) -> None:
    pin = pytest.importorskip("pinocchio")
    model = pin.Model()
    parent = 0
    for i, (link, slides) in enumerate(zip(robot.frames, robot.prismatic)):
        joint = pin.JointModelPZ() if slides else pin.JointModelRZ()
        parent = model.addJoint(parent, joint, pin.SE3(link), f"joint {i}")
    tool = model.addFrame(pin.Frame("tool", parent, 0, pin.SE3(robot.frames[-1]), pin.FrameType.OP_FRAME))
    data = model.createData()
    q, qd = np.random.default_rng(2).uniform(-2, 2, (2, robot.n))
    pin.computeJointJacobiansTimeVariation(model, data, q, qd)
    pin.updateFramePlacements(model, data)
    axes = pin.LOCAL_WORLD_ALIGNED if frame == "base" else pin.LOCAL
    theirs = pin.getFrameJacobianTimeVariation(model, data, tool, axes)
    np.testing.assert_allclose(jacobian_derivative(robot, q, qd, frame), theirs, rtol=0, atol=1e-13)  # type: ignore[arg-type]


def test_a_point_on_a_circle() -> None:
    """One joint at constant speed: the acceleration is r w^2 towards the centre; the tool tells a constant velocity."""
    robot = robots.from_dh("wheel", 0.0, [0.5], 0.0)
    q, qd = np.array([0.3]), np.array([2.0])
    radial = forward(robot, q)[:3, 0]
    np.testing.assert_allclose(
        jacobian_derivative(robot, q, qd) @ qd, [*(-0.5 * 4.0 * radial), 0, 0, 0], rtol=0, atol=1e-15
    )
    np.testing.assert_allclose(jacobian_derivative(robot, q, qd, frame="tool"), 0.0, rtol=0, atol=1e-15)


def test_tool_and_base_accelerations(robot: Robot) -> None:
    """In tool axes vd + w x v is the acceleration of the tool point, and wd the angular one."""
    q, qd = np.random.default_rng(3).uniform(-2, 2, (2, robot.n))
    R = forward(robot, q)[:3, :3]
    vd, wd = np.split(jacobian_derivative(robot, q, qd) @ qd, 2)
    vd_tool, wd_tool = np.split(jacobian_derivative(robot, q, qd, frame="tool") @ qd, 2)
    v_tool, w_tool = np.split(jacobian(robot, q, frame="tool") @ qd, 2)
    np.testing.assert_allclose(R @ (vd_tool + np.cross(w_tool, v_tool)), vd, rtol=0, atol=1e-12)
    np.testing.assert_allclose(R @ wd_tool, wd, rtol=0, atol=1e-12)


def test_batches_out_and_refusals() -> None:
    robot = robots.load("yumi_left")
    q, qd = np.random.default_rng(4).uniform(-1, 1, (2, 2, 3, 7))
    out = np.empty((2, 3, 6, 7))
    assert jacobian_derivative(robot, q, qd, out=out) is out
    np.testing.assert_array_equal(out[1, 2], jacobian_derivative(robot, q[1, 2], qd[1, 2]))
    assert jacobian_derivative(robot, np.zeros((0, 7)), np.zeros((0, 7))).shape == (0, 6, 7)
    with pytest.raises(UnknownName, match=r"Jacobian frame, got 'world'. Known: base, tool"):
        jacobian_derivative(robot, q, qd, frame="world")  # type: ignore[arg-type]
    with pytest.raises(ShapeError, match=r"Expected q of shape \(\.\.\., 7\), got \(6,\)"):
        jacobian_derivative(robot, np.zeros(6), np.zeros(6))
    with pytest.raises(ShapeError, match="Expected qd of the same shape as q"):
        jacobian_derivative(robot, q, qd[0])
