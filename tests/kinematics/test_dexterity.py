"""Singular values, manipulability and its gradient, ellipsoids; the self-motion of a redundant arm."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from armlab import lie, robots
from armlab.errors import RobotError, ShapeError, SingularPoseError, UnknownName
from armlab.kinematics import (
    ellipsoid,
    forward,
    jacobian,
    manipulability,
    manipulability_gradient,
    self_motion,
    singular_values,
)
from armlab.kinematics.dexterity import Ellipsoid, SelfMotion
from armlab.robots import Robot

ROWS = {"pose": slice(0, 6), "position": slice(0, 3), "rotation": slice(3, 6)}
PARTS: Any = list(ROWS)


ROUNDED = 4 * np.finfo(float).eps  # singular values are exact to a few roundings of the largest, 1 m here


@pytest.fixture(scope="module")
def planar() -> Robot:
    return robots.from_dh("planar", 0.0, [0.5, 0.4], 0.0)


@pytest.fixture(params=["yumi_left", "irb2400", "dh_test", "planar"])
def robot(request: pytest.FixtureRequest, planar: Robot) -> Robot:
    return planar if request.param == "planar" else robots.load(request.param)


def test_two_links_have_the_textbook_value(planar: Robot) -> None:
    """w = l1 l2 |sin q2| (Yoshikawa 1985), though J J^T of two joints is singular in every posture."""
    q = np.random.default_rng(0).uniform(-3, 3, (50, 2))
    wanted = 0.5 * 0.4 * np.abs(np.sin(q[:, 1]))
    np.testing.assert_allclose(manipulability(planar, q, "position"), wanted, rtol=0, atol=ROUNDED)


@pytest.mark.parametrize("bend", [1e-3, 1e-6, 1e-9, 1e-12])
def test_near_a_singular_posture_it_is_as_exact_as_the_jacobian(planar: Robot, bend: float) -> None:
    """The square root of det(J^T J) would be wrong by 1e-8 here."""
    for side in (1, -1):
        w = manipulability(planar, [0.7, side * bend], "position")
        assert w == pytest.approx(0.2 * np.sin(bend), abs=ROUNDED)
    smallest = 0.2 * bend / np.hypot(0.9, 0.4)
    assert singular_values(planar, [0.7, bend], "position")[-1] == pytest.approx(smallest, rel=bend, abs=ROUNDED)


@pytest.mark.parametrize("part", PARTS)
def test_it_is_the_root_of_the_determinant(robot: Robot, part: Any) -> None:
    q = np.random.default_rng(1).uniform(-2, 2, (20, robot.n))
    J = jacobian(robot, q)[:, ROWS[part]]
    J_transposed = np.swapaxes(J, 1, 2)
    gram = J @ J_transposed if J.shape[1] <= J.shape[2] else J_transposed @ J
    wanted = np.sqrt(np.maximum(np.linalg.det(gram), 0.0))
    np.testing.assert_allclose(manipulability(robot, q, part), wanted, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(singular_values(robot, q, part).prod(axis=1), wanted, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("name", ["yumi_left", "planar", "slider"])
def test_gradient_equals_central_differences(name: str, part: Any, planar: Robot) -> None:
    h = 1e-5
    slider = robots.from_dh("slider", [0.3, -1.2, 0.8, 0.5], 0.2, 0.3, prismatic=[False, True, False, False])
    robot = {"planar": planar, "slider": slider}.get(name) or robots.load(name)
    q = np.random.default_rng(2).uniform(-1.5, 1.5, (4, robot.n))
    steps = h * np.eye(robot.n)
    plus, minus = (manipulability(robot, q[:, None] + side * steps, part) for side in (1, -1))
    np.testing.assert_allclose(manipulability_gradient(robot, q, part), (plus - minus) / (2 * h), rtol=0, atol=1e-8)


def test_gradient_needs_no_division(planar: Robot) -> None:
    """At the kink, the gradient is one of the two slopes, l1 l2."""
    slope = np.abs(manipulability_gradient(planar, [0.3, 0.0], "position"))
    np.testing.assert_allclose(slope, [0, 0.2], rtol=0, atol=1e-15)


@pytest.mark.parametrize("part", ["position", "rotation"])
def test_velocities_lie_inside_and_on_the_ellipsoid(robot: Robot, part: Any) -> None:
    rng = np.random.default_rng(3)
    q, qd = rng.uniform(-2, 2, robot.n), rng.standard_normal((1000, robot.n))
    J = jacobian(robot, q)[ROWS[part]]
    body = ellipsoid(robot, q, part)
    assert isinstance(body, Ellipsoid)
    np.testing.assert_allclose(body.axes.T @ body.axes, np.eye(3), rtol=0, atol=1e-14)
    np.testing.assert_allclose(np.cross(body.axes[:, 0], body.axes[:, 1]), body.axes[:, 2], rtol=0, atol=1e-14)
    assert (np.diff(body.lengths) <= 0).all()
    inside = qd / np.linalg.norm(qd, axis=1, keepdims=True)
    along = inside @ J.T @ body.axes
    thick = body.lengths > 1e-9
    assert (along[:, ~thick] < 1e-12).all()
    assert ((along[:, thick] / body.lengths[thick]) ** 2).sum(axis=1).max() <= 1 + 1e-12
    reached = J @ (np.linalg.pinv(J) @ body.axes[:, 0]) * body.lengths[0]
    np.testing.assert_allclose(reached, body.axes[:, 0] * body.lengths[0], rtol=0, atol=1e-14)


def test_force_ellipsoid_is_reciprocal(robot: Robot, planar: Robot) -> None:
    q = np.full(robot.n, 0.4)
    fast, strong = ellipsoid(robot, q), ellipsoid(robot, q, kind="force")
    np.testing.assert_array_equal(fast.axes, strong.axes)
    ends = strong.axes[:, fast.lengths > 1e-9] * strong.lengths[fast.lengths > 1e-9]
    torques = jacobian(robot, q)[:3].T @ ends  # each needs joint torques of unit norm
    np.testing.assert_allclose(np.linalg.norm(torques, axis=0), 1.0, rtol=0, atol=1e-12)
    assert np.isinf(ellipsoid(planar, [0.1, 0.2], kind="force").lengths[2])


YUMI = robots.load("yumi_left")


def posture(seed: int, robot: Robot = YUMI) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.8 * robot.q_min, 0.8 * robot.q_max)


def pose_errors(robot: Robot, q: np.ndarray) -> tuple[float, float]:
    """Largest distance and rotation of the tool from the first pose, computed without the code under test."""
    T = forward(robot, q)
    turn = lie.so3.log(np.swapaxes(T[:1, :3, :3], 1, 2) @ T[:, :3, :3])
    return np.linalg.norm(T[:, :3, 3] - T[0, :3, 3], axis=1).max(), np.linalg.norm(turn, axis=1).max()


@pytest.mark.parametrize(("seed", "direction"), [(0, 1), (1, -1), (2, 1)])
def test_the_tool_stays_and_the_joints_stay_inside(seed: int, direction: Any) -> None:
    q = posture(seed)
    walk = self_motion(YUMI, q, direction=direction, length=2.0, points=201)
    assert isinstance(walk, SelfMotion)
    np.testing.assert_array_equal(walk.q[0], q)
    assert len(walk.q) >= 10
    for error, reported in zip(pose_errors(YUMI, walk.q), (walk.position_error, walk.rotation_error)):
        assert error <= 1e-9
        assert reported.max() <= 1e-9
    assert (YUMI.q_min <= walk.q).all()
    assert (walk.q <= YUMI.q_max).all()
    steps = np.diff(walk.q, axis=0)
    np.testing.assert_allclose(np.diff(walk.s)[:-1], 0.01, rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(steps, axis=1), np.diff(walk.s), rtol=0.01)  # chords of bends
    tangents = steps / np.linalg.norm(steps, axis=1, keepdims=True)
    assert np.vecdot(tangents[1:], tangents[:-1]).min() > 0.9  # a smooth curve
    if walk.end == "length":
        assert walk.s[-1] == 2.0
    else:
        k = int(walk.end.removeprefix("limit of joint ")) - 1
        assert min(walk.q[-1, k] - YUMI.q_min[k], YUMI.q_max[k] - walk.q[-1, k]) <= 1e-9


def test_the_sign_is_that_of_the_joint_that_moves_most() -> None:
    q = posture(0)
    forth, back = (self_motion(YUMI, q, direction=sign, length=0.02, points=2) for sign in (1, -1))
    step = forth.q[1] - q
    assert step[np.argmax(np.abs(step))] > 0
    np.testing.assert_allclose(back.q[1] - q, -step, rtol=0, atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(jacobian(YUMI, q) @ step), 0.0, rtol=0, atol=1e-3)


def test_uphill_ends_where_the_gradient_has_no_part_left() -> None:
    gradient = partial(manipulability_gradient, YUMI)
    walk = self_motion(YUMI, posture(3), direction=gradient, length=10.0, points=201)
    assert walk.end == "optimum"
    q = walk.q[-1]
    along = np.linalg.svd(jacobian(YUMI, q))[2][6:]
    assert np.abs(along @ manipulability_gradient(YUMI, q)).max() <= 1e-6
    assert max(pose_errors(YUMI, walk.q)) <= 1e-9


def test_a_six_joint_arm_turns_about_its_tool_axis() -> None:
    robot = robots.load("irb2400")
    q = np.array([0.1, 0.2, -0.3, 0.4, 0.8, 0.2])
    walk = self_motion(robot, q, task="axis", length=1.0, points=11)
    T = forward(robot, walk.q)
    assert np.abs(T[:, :3, 2] - T[0, :3, 2]).max() <= 1e-9
    assert np.abs(T[:, :3, 3] - T[0, :3, 3]).max() <= 1e-9
    assert lie.so3.angle(T[0, :3, :3], T[-1, :3, :3]) > 0.3


def test_of_several_dimensions_one_is_chosen() -> None:
    """Position only: 7 joints leave four dimensions of self-motion."""
    q, wish = posture(0), np.array([0, 0, 1.0, 0, 0, 0, 0])
    walk = self_motion(YUMI, q, task="position", direction=wish, length=0.5, points=6)
    assert pose_errors(YUMI, walk.q)[0] <= 1e-9
    assert walk.q[1, 2] > q[2]
    with pytest.raises(SingularPoseError, match="within the 4 dimensions of this self-motion, got only the sign 1"):
        self_motion(YUMI, q, task="position")


def test_planar_arms_have_what_their_rank_leaves() -> None:
    """Four parallel axes: rank 3 of the pose, one dimension of self-motion."""
    planar = robots.from_dh("planar", 0.0, [0.5, 0.4, 0.3, 0.2], 0.0)
    walk = self_motion(planar, [0.1, 0.4, 0.5, 0.6], length=1.0, points=11)
    assert walk.end == "length"
    assert max(pose_errors(planar, walk.q)) <= 1e-9


def test_a_tool_on_the_only_axis_does_not_move_at_all() -> None:
    """No row of the task then depends on the joint: the whole joint space is self-motion."""
    walk = self_motion(robots.from_dh("one", 0.0, [0.0], 0.3), [0.0], task="position", length=0.5, points=3)
    np.testing.assert_array_equal(walk.q, [[0.0], [0.25], [0.5]])
    assert walk.end == "length"


def test_prismatic_joints() -> None:
    robot = replace(YUMI, prismatic=np.arange(7) == 0)
    walk = self_motion(robot, posture(3), length=0.5, points=6)
    assert len(walk.q) > 1
    assert max(pose_errors(robot, walk.q)) <= 1e-9


DH = partial(robots.from_dh, "planar", 0.0)
WALK = partial(self_motion, YUMI, posture(0))


@pytest.mark.parametrize(("error", "words", "call"), [
    (RobotError, "a redundant joint for the task 'pose', got 'irb2400', which needs all its 6",
     lambda: self_motion(robots.load("irb2400"), np.ones(6) / 5)),
    (RobotError, "'planar', which needs all its 3 joints", lambda: self_motion(DH([0.5, 0.4, 0.3], 0.0), np.ones(3))),
    (UnknownName, r"task, got \['pose'\]", lambda: WALK(task=["pose"])),
    (ShapeError, "Expected q inside the limits of 'yumi_left', got 3 for joint 1",
     lambda: self_motion(YUMI, [3.0, 0, 0, 0, 0, 0, 0])),
    (ShapeError, "Expected direction", lambda: WALK(direction=[1.0, 2.0])),
    (ShapeError, "Expected the gradient that direction", lambda: WALK(direction=lambda _: np.zeros(3))),
    *((ShapeError, "length above 0 and up to 1000, and from 2 to 1000000 points",
       partial(WALK, length=length, points=points))
      for length, points in ((1001.0, 5), (0.0, 5), (np.nan, 5), (1.0, 1), (1.0, 10**30), (1.0, 2.5), ("1", 5))),
    (SingularPoseError, "a direction with a component along", lambda: WALK(direction=jacobian(YUMI, posture(0))[0])),
    (SingularPoseError, "a regular start posture",
     lambda: self_motion(DH([0.5, 0.4, 0.3, 0.2], 0.0), np.zeros(4))),
])  # fmt: skip
def test_refusals_of_a_walk(error: type[Exception], words: str, call: Callable[[], Any]) -> None:
    with pytest.raises(error, match=words):
        call()
