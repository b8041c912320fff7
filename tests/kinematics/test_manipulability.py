"""Manipulability: closed forms, determinants, singular postures, arms with few joints, gradient, ellipsoids."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.errors import ShapeError, UnknownName
from armlab.kinematics import ellipsoid, jacobian, manipulability, singular_values
from armlab.kinematics.dexterity import Ellipsoid, manipulability_gradient
from armlab.robots import Robot

ROWS = {"pose": slice(0, 6), "position": slice(0, 3), "rotation": slice(3, 6)}
PARTS: Any = list(ROWS)


ROUNDED = 4 * np.finfo(float).eps  # singular values are exact to some roundings of the largest, 1 m here


@pytest.fixture(scope="module")
def planar() -> Robot:
    return robots.from_dh("planar", 0.0, [0.5, 0.4], 0.0)


@pytest.fixture(params=[*robots.names(), "planar"])
def robot(request: pytest.FixtureRequest, planar: Robot) -> Robot:
    return planar if request.param == "planar" else robots.load(request.param)


def test_two_links_have_the_textbook_value(planar: Robot) -> None:
    """w = l1 l2 |sin q2| (Yoshikawa 1985), though J J^T of two joints is singular in every posture."""
    q = np.random.default_rng(0).uniform(-3, 3, (50, 2))
    wanted = 0.5 * 0.4 * np.abs(np.sin(q[:, 1]))
    np.testing.assert_allclose(manipulability(planar, q, "position"), wanted, rtol=0, atol=ROUNDED)


@pytest.mark.parametrize("bend", [1e-3, 1e-6, 1e-9, 1e-12])
def test_near_a_singular_posture_it_is_as_exact_as_the_jacobian(planar: Robot, bend: float) -> None:
    """The root of det(J^T J) would be wrong by 1e-8 here."""
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
@pytest.mark.parametrize("name", ["yumi_left", "irb2400", "planar", "slider"])
def test_gradient_equals_central_differences(name: str, part: Any, planar: Robot) -> None:
    h = 1e-5
    slider = robots.from_dh("slider", [0.3, -1.2, 0.8, 0.5], 0.2, 0.3, prismatic=[False, True, False, False])
    robot = {"planar": planar, "slider": slider}.get(name) or robots.load(name)
    q = np.random.default_rng(2).uniform(-1.5, 1.5, (4, robot.n))
    steps = h * np.eye(robot.n)
    plus, minus = (manipulability(robot, q[:, None] + side * steps, part) for side in (1, -1))
    np.testing.assert_allclose(manipulability_gradient(robot, q, part), (plus - minus) / (2 * h), rtol=0, atol=1e-8)


def test_gradient_needs_no_division(planar: Robot) -> None:
    """At the kink it is one of the slopes, l1 l2."""
    np.testing.assert_allclose(
        np.abs(manipulability_gradient(planar, [0.3, 0.0], "position")), [0, 0.2], rtol=0, atol=1e-15
    )


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
    torques = jacobian(robot, q)[:3].T @ ends  # each needs joint torques of length one
    np.testing.assert_allclose(np.linalg.norm(torques, axis=0), 1.0, rtol=0, atol=1e-12)
    assert np.isinf(ellipsoid(planar, [0.1, 0.2], kind="force").lengths[2])


def test_batches_keep_their_shape_and_nan_stays_in_its_sample() -> None:
    robot = robots.load("yumi_left")
    for batch in ((), (3,), (2, 3), (0,)):
        q = np.random.default_rng(4).uniform(-1, 1, (*batch, 7))
        assert np.shape(manipulability(robot, q)) == batch
        assert manipulability_gradient(robot, q).shape == (*batch, 7)
        assert singular_values(robot, q, "position").shape == (*batch, 3)
        assert ellipsoid(robot, q).axes.shape == (*batch, 3, 3)
        for i in np.ndindex(batch):
            assert manipulability(robot, q)[i] == manipulability(robot, q[i])
            np.testing.assert_array_equal(manipulability_gradient(robot, q)[i], manipulability_gradient(robot, q[i]))
    q = np.full((2, 7), 0.3)
    q[1, 2] = np.nan
    body = ellipsoid(robot, q)
    for value in (manipulability(robot, q), manipulability_gradient(robot, q), body.axes, body.lengths):
        assert np.isfinite(value[0]).all()
        assert np.isnan(value[1]).all()


def test_refusals() -> None:
    robot: Robot = robots.load("irb2400")
    unknown: Any = "speed"
    for function in (manipulability, manipulability_gradient, singular_values):
        with pytest.raises(UnknownName, match=r"part of a twist, got 'speed'. Known: pose, position, rotation"):
            function(robot, np.zeros(6), unknown)
        with pytest.raises(ShapeError, match=r"Expected q of shape \(\.\.\., 6\), got \(7,\)"):
            function(robot, np.zeros(7))
    with pytest.raises(UnknownName, match=r"part of a twist with an ellipsoid, got 'speed'. Known: position, rotation"):
        ellipsoid(robot, np.zeros(6), unknown)
    with pytest.raises(UnknownName, match=r"kind of ellipsoid, got 'speed'. Known: force, velocity"):
        ellipsoid(robot, np.zeros(6), kind=unknown)
