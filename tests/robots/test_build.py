"""DH tables and links: against a product of matrices typed in here, and the ancestors' numbers."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import kinematics, robots
from armlab.errors import RobotError
from armlab.lie import quaternion
from armlab.robots import GRAVITY, RAMP_TIME, Details, Robot


def dh_matrix(theta: float, d: float, a: float, alpha: float) -> np.ndarray:
    """The matrix of the textbooks, entry by entry."""
    ct, st, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
    return np.array([[ct, -st * ca, st * sa, a * ct], [st, ct * ca, -ct * sa, a * st], [0, sa, ca, d], [0, 0, 0, 1]])


def craig_matrix(theta: float, d: float, a: float, alpha: float) -> np.ndarray:
    """Craig, Introduction to Robotics, equation 3.6."""
    ct, st, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
    return np.array([[ct, -st, 0, a], [st * ca, ct * ca, -sa, -sa * d], [st * sa, ct * sa, ca, ca * d], [0, 0, 0, 1]])


def product(matrix, table: np.ndarray, prismatic: np.ndarray, q: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    for (alpha, a, d, offset), slides, position in zip(table.T, prismatic, q):
        T = T @ matrix(offset + position * (not slides), d + position * slides, a, alpha)
    return T


@pytest.mark.parametrize("modified", [False, True])
def test_from_dh_equals_the_textbook_product(modified: bool) -> None:
    """Random robots of 2 to 9 joints, revolute and prismatic; tests/laws has a thousand of them in all forms."""
    rng = np.random.default_rng(0)
    matrix = craig_matrix if modified else dh_matrix
    for _ in range(300):
        n = int(rng.integers(2, 10))
        table = rng.uniform(-np.pi, np.pi, (4, n)) * [[1], [0.3], [0.3], [1]]
        prismatic = rng.random(n) < 0.3
        robot = robots.from_dh("random", *table, prismatic=prismatic, modified=modified)
        q = rng.uniform(-3, 3, n)
        np.testing.assert_allclose(
            kinematics.forward(robot, q), product(matrix, table, prismatic, q), atol=1e-12, rtol=0
        )


def test_link_frames_are_dh_frames_before_the_shift() -> None:
    """Link frame i followed by Tz(d) Tx(a) Rx(alpha) is DH frame i."""
    rng = np.random.default_rng(1)
    table = rng.uniform(-1, 1, (4, 5))
    robot = robots.from_dh("random", *table)
    q = rng.uniform(-1, 1, 5)
    links = kinematics.link_transforms(robot, q)
    for i in range(5):
        alpha, a, d, _ = table[:, i]
        expected = product(dh_matrix, table[:, : i + 1], np.zeros(5, bool), q[: i + 1])
        np.testing.assert_allclose(links[i] @ dh_matrix(0.0, d, a, alpha), expected, rtol=0, atol=1e-14)


def test_a_number_stands_for_all_rows() -> None:
    robot = robots.from_dh("planar", 0.0, [0.5, 0.4], 0.0)
    np.testing.assert_allclose(robot.T_home[:3, 3], [0.9, 0, 0])
    assert robot.n == 2


def test_defaults_of_details() -> None:
    robot = robots.from_dh("r", 0.0, [1.0, 1.0], 0.0)
    assert (robot.q_max == np.inf).all()
    assert (robot.qdd_max == np.inf).all()
    np.testing.assert_array_equal(robot.q_home, 0)
    np.testing.assert_array_equal(robot.gravity, GRAVITY)
    np.testing.assert_array_equal(robot.coupling, np.eye(2))
    assert robot.joint_names == ("joint_1", "joint_2")
    assert robot.abb_axes == (1, 2)
    assert (robot.side, robot.source) == ("", "")
    limited = robots.from_dh("r", 0.0, [1.0, 1.0], 0.0, q_min=[0.5, -2], q_max=[1, -1], qd_max=[2.0, 3.0])
    np.testing.assert_array_equal(limited.q_home, [0.5, -1])
    np.testing.assert_array_equal(limited.qdd_max, np.array([2.0, 3.0]) / RAMP_TIME)


def test_a_misspelt_detail_is_refused() -> None:
    """Limits that are not taken would be infinite."""
    with pytest.raises(RobotError, match="got 'q_maxx'"):
        robots.from_dh("r", 0.0, [1.0, 1.0], 0.0, q_maxx=[1.0, 1.0])  # type: ignore[call-arg]


def test_details_name_fields_of_robot() -> None:
    assert set(Details.__annotations__) < set(Robot.__dataclass_fields__)


def test_from_links() -> None:
    rng = np.random.default_rng(2)
    q = rng.standard_normal((3, 4))
    links = np.tile(np.eye(4), (3, 1, 1))
    links[:, :3, :3] = quaternion.to_matrix(q / np.linalg.norm(q, axis=1, keepdims=True))
    robot = robots.from_links("r", links, [False, True])
    np.testing.assert_array_equal(robot.frames, links)
    np.testing.assert_allclose(robot.T_home, links[0] @ links[1] @ links[2], rtol=0, atol=1e-15)


@pytest.mark.parametrize(
    ("columns", "sentence"),
    [
        (
            ([0.0, 0.0], [1.0, 1, 1], 0.0),
            "Expected DH columns of one length for robot 'r', got alpha 2, a 3, d 1, offset 1.",
        ),
        (([0.0, np.nan], 1.0, 0.0), "Expected finite alpha in the DH table of 'r', got nan at joint 2."),
        (([0.0, 0.0], 1.0, [0.0, np.inf]), "Expected finite d in the DH table of 'r', got inf at joint 2."),
    ],
)
def test_bad_tables_are_refused_with_a_sentence(columns: tuple, sentence: str) -> None:
    with pytest.raises(RobotError) as caught:
        robots.from_dh("r", *columns)
    assert str(caught.value) == sentence


def test_a_prismatic_flag_per_joint() -> None:
    with pytest.raises(RobotError, match="of robot 'r'"):
        robots.from_dh("r", 0.0, [1.0, 1.0], 0.0, prismatic=[True])


def test_limits_that_look_like_degrees_are_doubted() -> None:
    with pytest.warns(UserWarning, match=r"'r' within four turns, got joint_2 \(-170 to 170 rad\)\. If these are d"):
        robot = robots.from_dh("r", 0.0, [1.0, 1.0], 0.0, q_min=[-3.0, -170.0], q_max=[3.0, 170.0])
    assert robot.q_max[1] == 170.0
    turns = 2.0 * np.pi * np.array([1.1, 4.0, 96.0, np.inf])  # 400 degrees; an ABB wrist; without end
    robots.from_dh("wide", 0.0, np.ones(4), 0.0, q_min=-turns, q_max=turns)
    robots.from_dh("slide", 0.0, 1.0, 0.0, prismatic=[True], q_min=[0.0], q_max=[100.0])


def test_angles_of_a_table_that_look_like_degrees_are_doubted() -> None:
    with pytest.warns(UserWarning, match=r"one turn, got alpha of 90 rad in the DH table of 'two links'\. If th"):
        robots.from_dh("two links", 90.0, [1.0, 1.0], 0.0)
    with pytest.warns(UserWarning, match="got offset of 180 rad"):
        robots.from_dh("r", 0.0, [1.0, 1.0], 0.0, [0.0, -180.0])
    robots.from_dh("r", [2.0 * np.pi, -np.pi], [1.0, 1.0], 0.0, [-np.pi, 2.0 * np.pi])
