"""The synthetic truth has the golden values of the specification and says no to what it does not know."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import robots
from armlab.errors import ConfigError, ShapeError, UnknownName
from armlab.sim.arm.truth import Truth, cylinder, synthetic_truth, truth_names

GRAVITY = np.array([0.0, 0.0, -9.81])
G_LEFT = [6.20953, 5.37511, -0.02260, 0.53069, -0.00042, -0.02481, 0.0]
G_RIGHT = [-6.20953, 5.37511, 0.02260, 0.53069, 0.00042, -0.02481, 0.0]


@pytest.mark.parametrize(("name", "expected"), [("yumi_left", G_LEFT), ("yumi_right", G_RIGHT)])
def test_gravity_at_home_is_golden(name: str, expected: list[float]) -> None:
    robot = robots.load(name)
    zero = np.zeros(7)
    G = robot.chain.rnea(robot.q_home, zero, zero, GRAVITY, synthetic_truth(robot).pi)
    np.testing.assert_allclose(G, expected, atol=6e-6)


@pytest.mark.parametrize("name", ["yumi_left", "yumi_right"])
def test_mass_matrix_diagonal_is_golden(name: str) -> None:
    robot = robots.load(name)
    pi, zero = synthetic_truth(robot).pi, np.zeros(7)
    M = [robot.chain.rnea(robot.q_home, zero, unit, np.zeros(3), pi) for unit in np.eye(7)]
    np.testing.assert_allclose(np.diag(M), [0.1636, 0.1976, 0.1013, 0.0803, 0.0016, 0.0009, 0.0002], atol=6e-5)


def test_flange_at_home_is_golden() -> None:
    robot = robots.load("yumi_left")
    np.testing.assert_allclose(robot.chain.forward(robot.q_home)[:3, 3], [-0.018163, 0.186292, 0.195626], atol=1e-6)


def test_yumi_parameters_follow_the_rule() -> None:
    truth = synthetic_truth(robots.load("yumi_left"))
    np.testing.assert_array_equal(truth.tau_max, [40, 40, 25, 25, 10, 10, 5])
    np.testing.assert_array_equal(truth.pi[:, 0], [1.7, 1.6, 1.4, 1.1, 0.9, 0.5, 0.2])
    np.testing.assert_allclose(truth.coulomb_pos, 0.0525 * truth.tau_max)
    np.testing.assert_allclose(truth.coulomb_neg, 0.0475 * truth.tau_max)
    np.testing.assert_allclose(truth.viscous * np.radians([180] * 4 + [400] * 3), 0.05 * truth.tau_max)
    np.testing.assert_allclose(truth.offset, 0.01 * truth.tau_max * [1, -1, 1, -1, 1, -1, 1])
    np.testing.assert_allclose(truth.ripple_cycles, [200, 200, 200, 200, 200, 202, 200])
    np.testing.assert_allclose(truth.rotor, 0.1)
    np.testing.assert_allclose(truth.static_ratio, 1.3)


@pytest.mark.parametrize("name", truth_names())
def test_every_simulated_robot_is_physical(name: str) -> None:
    robot = robots.load(name)
    truth = synthetic_truth(robot)
    for m, x, y, z, *rest in truth.pi:
        centre = np.array([x, y, z]) / m
        inertia = np.array([[rest[0], rest[1], rest[3]], [rest[1], rest[2], rest[4]], [rest[3], rest[4], rest[5]]])
        inertia -= m * (centre @ centre * np.eye(3) - np.outer(centre, centre))
        moments = np.linalg.eigvalsh(inertia)
        assert moments[0] > 0
        assert moments[2] <= moments[0] + moments[1] + 1e-12
    zero = np.zeros(robot.n)
    G = robot.chain.rnea(robot.q_home, zero, zero, robot.gravity, truth.pi)
    assert (np.abs(G) < 0.5 * truth.tau_max).all(), "the drives can hold the arm"


def test_cylinder_is_the_textbook_one() -> None:
    pi = cylinder(2.0, np.array([0.0, 0.0, 0.5]), 0.1, 0.06)
    across = 2.0 * (3 * 0.01 + 0.25) / 12 + 2.0 * 0.25**2
    np.testing.assert_allclose(pi, [2, 0, 0, 0.5, across, 0, across, 0, 0, 0.01], atol=1e-15)
    point = cylinder(2.0, np.zeros(3), 0.1, 0.3)
    np.testing.assert_allclose(point[[4, 6, 9]], [2 * (0.03 + 0.09) / 12] * 2 + [0.01])


def test_effects_can_be_switched_off() -> None:
    truth = synthetic_truth(robots.load("yumi_left"))
    silent = truth.without("noise", "ripple")
    assert not silent.tau_noise.any()
    assert not silent.q_step.any()
    assert not silent.ripple.any()
    assert truth.tau_noise.all()
    assert silent.viscous.all()
    with pytest.raises(UnknownName, match="ripple"):
        truth.without("rippel")


def test_payload_adds_a_point_mass() -> None:
    truth = synthetic_truth(robots.load("yumi_left"))
    loaded = truth.with_payload(0.5, np.array([0, 0, 0.1]))
    np.testing.assert_allclose(loaded.pi[-1] - truth.pi[-1], [0.5, 0, 0, 0.05, 0.005, 0, 0.005, 0, 0, 0], atol=1e-15)
    np.testing.assert_array_equal(loaded.pi[:-1], truth.pi[:-1])
    with pytest.raises(ConfigError, match="-1"):
        truth.with_payload(-1.0, np.zeros(3))


def test_unknown_robot_lists_the_known() -> None:
    with pytest.raises(UnknownName, match="yumi_left"):
        synthetic_truth(robots.load("dh_test"))


def test_shapes_are_checked() -> None:
    truth = synthetic_truth(robots.load("yumi_left"))
    fields = {name: getattr(truth, name) for name in Truth.__dataclass_fields__}
    with pytest.raises(ShapeError, match="viscous"):
        Truth(**fields | {"viscous": np.ones(3)})
    with pytest.raises(ValueError, match="read-only"):
        truth.pi[0, 0] = 1.0
