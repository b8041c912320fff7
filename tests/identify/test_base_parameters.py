"""Base parameters: known ranks, exact evaluation, readable names."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import robots
from armlab.errors import RobotError, UnknownName
from armlab.identify import BaseParameters, base_parameters
from armlab.identify.base_parameters import measured_joints
from armlab.lie import se3


def test_ranks_of_the_yumi_arm_are_the_published_ones() -> None:
    """14 for gravity, 45 rigid, 50 with rotor inertia (specification, section 4.2)."""
    robot = robots.load("yumi_left")
    base = base_parameters(robot)
    assert isinstance(base, BaseParameters)
    assert len(base.names) == len(base.kept) == 50
    rng = np.random.default_rng(0)
    q, qd, qdd = rng.uniform(-2, 2, (3, 400, 7))
    Y = robot.chain.rigid_regressor(q, qd, qdd, robot.gravity).reshape(-1, 70)
    at_rest = robot.chain.rigid_regressor(q, 0 * q, 0 * q, robot.gravity).reshape(-1, 7, 10)
    G = at_rest[..., :4].reshape(-1, 28)
    assert np.linalg.matrix_rank(Y) == 45
    assert np.linalg.matrix_rank(G) == 14


@pytest.mark.parametrize("name", ["yumi_left", "irb2400", "ur5e"])
def test_axes_that_are_a_little_off_do_not_count_as_others(name: str) -> None:
    """A calibrated arm: 1 mm and 1 mrad make no columns that nearly depend on others; torques keep to a thousandth."""
    robot, rng = robots.load(name), np.random.default_rng(1)
    frames = robot.frames @ se3.exp(1e-3 * rng.standard_normal((robot.n + 1, 6)))
    frames[0] = robot.frames[0]
    arm = robots.from_local_poe(name, frames, np.tile([0.0, 0, 0, 0, 0, 1], (robot.n, 1)))
    base, pi = base_parameters(arm), rng.standard_normal(11 * robot.n)
    q, qd, qdd = rng.uniform(-3, 3, (3, 50, robot.n))
    Y = arm.chain.rigid_regressor(q, qd, qdd, arm.gravity)
    own = np.eye(robot.n) * qdd[:, :, None]
    A = np.concatenate([Y, own], axis=2).reshape(-1, 11 * robot.n)
    kept = A[:, base.kept] / np.linalg.norm(A[:, base.kept], axis=0)
    assert np.linalg.cond(kept) < 1e3
    expected = A @ pi
    np.testing.assert_allclose(A @ base.lift @ base.B @ pi, expected, rtol=0, atol=5e-3 * np.abs(expected).max())


@pytest.mark.parametrize("name", ["yumi_left", "yumi_right", "irb2400", "irb7600"])
def test_base_parameters_give_the_torque_of_any_link_parameters(name: str) -> None:
    robot = robots.load(name)
    base = base_parameters(robot)
    rng = np.random.default_rng(1)
    pi = rng.standard_normal(11 * robot.n)
    links, rotor = base.links_and_rotors(base.B @ pi)
    q, qd, qdd = rng.uniform(-3, 3, (3, 50, robot.n))

    def torque(links: np.ndarray, rotor: np.ndarray) -> np.ndarray:
        return robot.chain.rnea(q, qd, qdd, robot.gravity, links) + rotor * qdd

    expected = torque(pi[: 10 * robot.n].reshape(-1, 10), pi[10 * robot.n :])
    np.testing.assert_allclose(torque(links, rotor), expected, atol=1e-9 * np.abs(expected).max())
    assert np.linalg.norm([*links.ravel(), *rotor]) <= np.linalg.norm(pi) * (1 + 1e-9)


def test_names_say_what_moves_with_what() -> None:
    names = base_parameters(robots.load("yumi_left")).names
    assert "m c_y1 + m c_z2" in names
    assert "rotor7" in names
    assert any(name.startswith("I_zz1") and name.endswith("rotor1") for name in names)


def lift() -> robots.Robot:
    """A vertical slide that carries a turning link."""
    turned = np.eye(4)
    turned[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    return robots.from_links("lift", [np.eye(4), turned, np.eye(4)], prismatic=[True, False])


def test_weight_on_a_vertical_slide_counts_as_its_offset() -> None:
    """Gravity of all that a lift carries is constant: only its inertia is a base parameter."""
    robot = lift()
    base = base_parameters(robot)
    assert base.offset_names[0].startswith("offset")
    assert "9.80665 m1 + 9.80665 m2" in base.offset_names[0]
    assert base.offset_names[1] == f"offset {robot.joint_names[1]}"
    assert not any(name.startswith("m1") for name in base.names)
    rng = np.random.default_rng(2)
    pi = rng.uniform(0.5, 1.0, 22)
    links, rotor = base.links_and_rotors(base.B @ pi)
    q, qd, qdd = rng.uniform(-1, 1, (3, 40, 2))
    expected = robot.chain.rnea(q, qd, qdd, robot.gravity, pi[:20].reshape(2, 10)) + pi[20:] * qdd
    found = robot.chain.rnea(q, qd, qdd, robot.gravity, links) + rotor * qdd
    np.testing.assert_allclose(found + base.D @ pi, expected, atol=1e-10)


def test_sums_of_masses_inertias_and_rotors_are_not_negative() -> None:
    base = base_parameters(robots.load("yumi_left"))
    bounded = [name for name, low in zip(base.names, base.lower) if low == 0]
    assert "rotor7" in bounded
    assert any("rotor1" in name for name in bounded)
    assert not any(name.startswith("m c_") or " - " in name for name in bounded)


def test_gravity_alone_has_masses_and_first_moments() -> None:
    base = base_parameters(robots.load("yumi_left"), quasi_static=True)
    assert base.quasi_static
    assert len(base.names) == 14
    assert set(base.units) <= {"kg", "kg m"}


def test_joints_without_measured_torque_show_fewer_combinations() -> None:
    robot = robots.load("yumi_left")
    some = base_parameters(robot, joints=[4, 5, 6])
    assert len(some.names) < 50
    assert not some.seen[:4].any()
    assert some.seen[4:].any(axis=1).all()


def test_joints_are_counted_from_zero_and_a_name_is_no_robot() -> None:
    robot = robots.load("yumi_left")
    assert measured_joints(robot) == list(range(7))
    assert measured_joints(robot, np.array([2, 0])) == [0, 2]
    for joints in ([7], [-1], [], [1, 1], ["axis_1"], [1.5], 3):
        with pytest.raises(UnknownName, match="from 0 to 6"):
            base_parameters(robot, joints=joints)  # type: ignore[arg-type]
    with pytest.raises(RobotError, match="Load it first"):
        base_parameters("yumi_left")  # type: ignore[arg-type]
