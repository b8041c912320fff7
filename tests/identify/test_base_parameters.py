"""Base parameters: known ranks, exact evaluation, readable names."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import robots
from armlab.identify import BaseParameters, base_parameters


def test_ranks_of_the_yumi_arm_are_the_published_ones() -> None:
    """14 for gravity, 45 rigid, 50 with rotor inertia (specification, section 4.2)."""
    robot = robots.load("yumi_left")
    base = base_parameters(robot)
    assert isinstance(base, BaseParameters)
    assert len(base.names) == len(base.kept) == 50
    rng = np.random.default_rng(0)
    q, qd, qdd = rng.uniform(-2, 2, (3, 400, 7))
    Y = robot.chain.rigid_regressor(q, qd, qdd, robot.gravity).reshape(-1, 70)
    G = robot.chain.gravity_regressor(q, robot.gravity).reshape(-1, 28)
    assert np.linalg.matrix_rank(Y) == 45
    assert np.linalg.matrix_rank(G) == 14


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
