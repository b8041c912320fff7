"""The reference `Chain` on cases that can be written down by hand; the contract test holds the compiled one to it."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.kernels._reference.chain import Chain


@pytest.fixture
def planar() -> Chain:
    """Two links of 1 m and 0.5 m that turn about z."""
    frames = np.tile(np.eye(4), (3, 1, 1))
    frames[1, 0, 3], frames[2, 0, 3] = 1.0, 0.5
    return Chain(frames, [False, False])


def test_forward_of_two_links(planar: Chain) -> None:
    T = planar.forward([np.pi / 2, -np.pi / 2])
    np.testing.assert_allclose(T[:3, 3], [0.5, 1.0, 0.0], rtol=0, atol=1e-15)
    np.testing.assert_allclose(T[:3, :3], np.eye(3), rtol=0, atol=1e-15)


def test_jacobian_of_two_links(planar: Chain) -> None:
    J = planar.jacobian([0.0, np.pi / 2])
    np.testing.assert_allclose(J[[0, 1, 5]], [[-0.5, -0.5], [1.0, 0.0], [1.0, 1.0]], rtol=0, atol=1e-15)
    J_tool = planar.jacobian([0.0, np.pi / 2], tool=True)
    np.testing.assert_allclose(J_tool[[0, 1, 5]], [[1.0, 0.0], [0.5, 0.5], [1.0, 1.0]], rtol=0, atol=1e-15)


def test_sliding_joint() -> None:
    lift = Chain(np.tile(np.eye(4), (2, 1, 1)), [True])
    np.testing.assert_allclose(lift.forward([0.3])[:3, 3], [0.0, 0.0, 0.3])
    np.testing.assert_allclose(lift.jacobian([0.3])[:, 0], [0, 0, 1, 0, 0, 0])
    pi = np.zeros((1, 10))
    pi[0, 0] = 2.0
    np.testing.assert_allclose(lift.rnea([0.3], [1.0], [0.5], [0.0, 0.0, -9.81], pi), [2.0 * (0.5 + 9.81)])


def test_gravity_of_a_lever() -> None:
    """A mass m at distance r on a horizontal axis needs m g r cos(q)."""
    flat = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])
    lever = Chain(np.stack([flat, np.eye(4)]), [False])
    q = np.linspace(-3, 3, 7)[:, None]
    Y = lever.gravity_regressor(q, [0.0, 0.0, -9.81])
    np.testing.assert_allclose(Y @ [2.0, 2.0 * 0.3, 0.0, 0.0], 2.0 * 0.3 * 9.81 * np.cos(q), rtol=0, atol=1e-14)


def test_regressor_of_a_spinning_wheel() -> None:
    """About its own axis only Izz counts."""
    wheel = Chain(np.tile(np.eye(4), (2, 1, 1)), [False])
    Y = wheel.rigid_regressor([0.4], [3.0], [2.0], [0.0, 0.0, -9.81])
    np.testing.assert_allclose(Y[0], [0, 0, 0, 0, 0, 0, 0, 0, 0, 2.0], rtol=0, atol=1e-15)
