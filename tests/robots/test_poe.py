"""Screws: random robots of every kind, the ancestor's test robot, refusals."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import kinematics, robots
from armlab.errors import RobotError, ShapeError
from armlab.lie import se3
from armlab.robots import SCREW_TOLERANCE, LocalPoe, Robot


def random_screws(rng: np.random.Generator, n: int) -> np.ndarray:
    """Unit axes through random points; about a third slide."""
    axis = rng.standard_normal((n, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    slides = rng.random((n, 1)) < 0.3
    return np.where(slides, np.hstack([axis, 0 * axis]), np.hstack([np.cross(rng.standard_normal((n, 3)), axis), axis]))


def random_robot(rng: np.random.Generator, n: int) -> Robot:
    """Random links, kinds, mount and tool."""
    return robots.from_links(
        "random",
        se3.exp(rng.standard_normal((n + 1, 6))),
        rng.random(n) < 0.3,
        T_base_mount=se3.exp(rng.standard_normal(6)),
        T_flange_tool=se3.exp(rng.standard_normal(6)),
    )


def test_from_poe_is_the_product_of_exponentials() -> None:
    rng = np.random.default_rng(0)
    for _ in range(300):
        n = int(rng.integers(2, 10))
        screws, T_home, q = random_screws(rng, n), se3.exp(rng.standard_normal(6)), rng.uniform(-2, 2, n)
        robot = robots.from_poe("random", screws, T_home)
        T = np.eye(4)
        for xi, position in zip(screws, q):
            T = T @ se3.exp(xi * position)
        np.testing.assert_allclose(kinematics.forward(robot, q), T @ T_home, atol=1e-12, rtol=0)
        np.testing.assert_allclose(robot.screws, screws, rtol=0, atol=1e-14)
        np.testing.assert_allclose(robot.T_home, T_home, rtol=0, atol=1e-13)
        np.testing.assert_array_equal(robot.prismatic, ~screws[:, 3:].any(axis=1))


def test_the_three_forms_agree_on_random_robots() -> None:
    """Robots of 2 to 9 joints, revolute and prismatic, with mount and tool; tests/laws has a thousand of them."""
    rng = np.random.default_rng(1)
    for _ in range(100):
        robot = random_robot(rng, int(rng.integers(2, 10)))
        q = rng.uniform(-2, 2, robot.n)
        T = kinematics.forward(robot, q)
        for other in (
            robots.from_poe("poe", robot.screws, robot.T_home),
            robots.from_local_poe("local", *robots.to_local_poe(robot)),
        ):
            np.testing.assert_allclose(kinematics.forward(other, q), T, atol=1e-12, rtol=0)


def test_local_poe_of_a_robot() -> None:
    """``T = A_1 exp(xi_1 q_1) ... A_n exp(xi_n q_n) A_tool``, typed in."""
    rng = np.random.default_rng(2)
    robot = random_robot(rng, 5)
    local = robots.to_local_poe(robot)
    assert isinstance(local, LocalPoe)
    q = rng.standard_normal(5)
    T = np.eye(4)
    for pose, xi, position in zip(local.poses, local.screws, q):
        T = T @ pose @ se3.exp(xi * position)
    np.testing.assert_allclose(T @ local.poses[-1], kinematics.forward(robot, q), rtol=0, atol=1e-13)


def test_the_ancestors_test_robot() -> None:
    """Robotlib.jl's runtests.jl: axes z y y x y x. It takes v = -p × w, so its axes go through the points -p."""
    axes = np.array([[0, 0, 1], [0, 1, 0], [0, 1, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0]], dtype=float)
    points = -np.array([[0, 0, 0], [0, 0, 0.3], [0, 0, 1], [1, 0, 1], [1, 0, 1], [1, 0, 1]])
    T_home = [[0, -1, 0, 1.2], [0, 0, -1, 0], [1, 0, 0, 1], [0, 0, 0, 1.0]]
    robot = robots.from_poe("runtests", np.hstack([np.cross(points, axes), axes]), T_home)
    p = kinematics.forward(robot, 0.1 * np.arange(1, 7))[:3, 3]
    np.testing.assert_allclose(p, (1.447748001821, -1.054251457784, -1.879210347845), rtol=0, atol=1e-12)


def test_from_poe_takes_its_frames_behind_the_mount() -> None:
    T_base_mount = se3.exp([1, 2, 3, 0.1, 0.2, 0.3])
    screws = random_screws(np.random.default_rng(3), 4)
    robot = robots.from_poe("r", screws, np.eye(4), T_base_mount=T_base_mount)
    bare = robots.from_poe("r", screws, np.eye(4))
    q = np.ones(4)
    np.testing.assert_allclose(
        kinematics.forward(robot, q), T_base_mount @ kinematics.forward(bare, q), rtol=0, atol=1e-14
    )


def test_normalise_screw() -> None:
    np.testing.assert_allclose(robots.normalise_screw([1, 2, 3, 0, 0, 2]), [0.5, 1, 0, 0, 0, 1])
    np.testing.assert_allclose(robots.normalise_screw([1, 2, 3, 0, 0, 2], keep_pitch=True), [0.5, 1, 1.5, 0, 0, 1])
    np.testing.assert_allclose(robots.normalise_screw([0, 3, 4, 0, 0, 0]), [0, 0.6, 0.8, 0, 0, 0])
    rough = random_screws(np.random.default_rng(4), 50) * 1.3
    before = rough.copy()
    np.testing.assert_allclose(robots.normalise_screw(rough), before / 1.3, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(rough, before)
    assert robots.normalise_screw(rough.reshape(5, 10, 6)).shape == (5, 10, 6)


@pytest.mark.parametrize(
    ("screw", "sentence"),
    [
        (np.zeros(6), "other than zero"),
        ([0, 0, 0, 0, 0, np.nan], "not finite"),
        ([1, 2, 3], r"Expected screws of shape \(\.\.\., 6\), got \(3,\)\."),
    ],
)
def test_normalise_screw_refuses(screw: list, sentence: str) -> None:
    with pytest.raises(ShapeError, match=sentence):
        robots.normalise_screw(screw)


@pytest.mark.parametrize(
    ("screws", "T_home", "sentence"),
    [
        (
            [[0, 0, 0, 0, 0, 2.0]],
            np.eye(4),
            "for joint 1 of robot 'r', got length 2 and pitch 0 m/rad. Use robots",
        ),
        ([[0, 0, 1, 0, 0, 1]], np.eye(4), "got length 1 and pitch 1 m/rad"),
        ([[0, 0, 0, 0, 0, 0]], np.eye(4), "got length 0"),
        ([[0, 0, 0, 0, 0, np.nan]], np.eye(4), "got length nan"),
        ([[0, 0, 1, 0, 0]], np.eye(4), r"Expected screws of shape \(n, 6\)"),
        ([[0, 0, 0, 0, 0, 1]], 2 * np.eye(4), "Expected T_home of robot 'r' to be a pose"),
        ([[0, 0, 0, 0, 0, 1]], np.eye(3), "Expected T_home of robot 'r' to be a pose"),
    ],
)
def test_bad_screws_are_refused_with_a_sentence(screws: list, T_home: np.ndarray, sentence: str) -> None:
    assert SCREW_TOLERANCE == 1e-9
    with pytest.raises(RobotError, match=sentence):
        robots.from_poe("r", screws, T_home)
