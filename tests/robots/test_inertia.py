"""Inertial parameters: textbook bodies, round trips, and Pinocchio's inertias."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from armlab import kinematics, robots
from armlab.errors import ShapeError
from armlab.lie import se3
from armlab.robots.inertia import Body, from_body, principal_moments, to_body, transform


def random_bodies(n: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Masses, centres and inertias of n bodies, each a cloud of eight points."""
    rng = np.random.default_rng(seed)
    m, x = rng.uniform(0.1, 1, (n, 8, 1, 1)), rng.standard_normal((n, 8, 3))
    centre = (m[..., 0] * x).sum(axis=1) / m.sum(axis=(1, 3))
    x = x - centre[:, None]
    squares = (x * x).sum(axis=-1)[..., None, None] * np.eye(3) - x[..., :, None] * x[..., None, :]
    return m.sum(axis=(1, 2, 3)), centre, (m * squares).sum(axis=1)


def test_a_point_mass() -> None:
    pi = from_body(2.0, [1, 2, 3], np.zeros((3, 3)))
    np.testing.assert_array_equal(pi, [2, 2, 4, 6, 2 * (4 + 9), -2 * 1 * 2, 2 * (1 + 9), -2 * 1 * 3, -2 * 2 * 3, 2 * 5])
    np.testing.assert_allclose(principal_moments(pi), 0, rtol=0, atol=1e-14)


def test_there_and_back() -> None:
    m, c, inertia = random_bodies(50, 0)
    body = to_body(from_body(m, c, inertia))
    assert isinstance(body, Body)
    np.testing.assert_allclose(body.mass, m, rtol=1e-15, atol=0)
    np.testing.assert_allclose(body.centre, c, rtol=0, atol=1e-14)
    np.testing.assert_allclose(body.inertia, inertia, rtol=0, atol=1e-12)
    nothing = to_body(np.zeros(10))
    assert not np.any(nothing.centre)
    assert not np.any(nothing.inertia)


def test_transform_agrees_with_pinocchio() -> None:
    rng = np.random.default_rng(1)
    for m, c, inertia in zip(*random_bodies(50, 1)):
        T_a_b = se3.exp(rng.standard_normal(6))
        moved = pin.SE3(T_a_b).act(pin.Inertia(m, c, inertia))
        body = to_body(transform(T_a_b, from_body(m, c, inertia)))
        np.testing.assert_allclose(body.mass, moved.mass, rtol=1e-14, atol=0)
        np.testing.assert_allclose(body.centre, moved.lever, rtol=0, atol=1e-13)
        np.testing.assert_allclose(body.inertia, moved.inertia, rtol=0, atol=1e-12)


def test_principal_moments_do_not_depend_on_the_frame() -> None:
    pi = from_body(3.0, [0, 0, 0], np.diag([1.0, 3.0, 2.0]))
    T_a_b = se3.exp([5, -3, 1, 0.5, 1, -2])
    np.testing.assert_allclose(principal_moments(pi), [1, 2, 3], rtol=0, atol=1e-14)
    np.testing.assert_allclose(principal_moments(transform(T_a_b, pi)), [1, 2, 3], rtol=0, atol=1e-12)


@pytest.mark.parametrize(("call", "words"), [
    (lambda: from_body(1.0, [0, 0], np.eye(3)), r"Expected a centre of shape \(\.\.\., 3\)"),
    (lambda: from_body("heavy", np.zeros(3), np.eye(3)), "Expected mass to be real numbers, got 'heavy'"),
    (lambda: to_body(np.zeros(9)), r"Expected finite inertial parameters of shape \(\.\.\., 10\)"),
    (lambda: principal_moments(np.full(10, np.nan)), "Expected finite inertial parameters"),
    (lambda: transform(2 * np.eye(4), np.zeros(10)), "Expected the rotation of T_a_b"),
    (lambda: from_body([1, 2], np.zeros((3, 3)), np.eye(3)), r"that broadcast, got mass of shape \(2,\), centre of"),
    (lambda: transform(np.tile(np.eye(4), (2, 1, 1)), np.ones((3, 10))), r"T_a_b of shape .*, pi of shape \(3, 10\)"),
])  # fmt: skip
def test_bad_input_is_refused(call, words: str) -> None:
    with pytest.raises(ShapeError, match=words):
        call()


def test_a_gripper_weighs_on_the_last_link() -> None:
    """As the page on descriptions says: the holding torque is that of the gripper's weight at its position."""
    arm = robots.load("irb120")
    pi = from_body(1.2, [0, 0.01, 0.05], 0.002 * np.eye(3))
    inertias = np.zeros((arm.n, 10))
    inertias[-1] += transform(arm.links[-1], pi)
    q, still = np.random.default_rng(4).uniform(-1, 1, arm.n), np.zeros(arm.n)
    tau = arm.chain.rnea(q, still, still, arm.gravity, inertias)
    at_gripper = arm.with_tool(se3.from_rp(np.eye(3), [0, 0.01, 0.05]))
    weight = np.concatenate([-1.2 * arm.gravity, np.zeros(3)])
    np.testing.assert_allclose(tau, kinematics.jacobian(at_gripper, q).T @ weight, rtol=0, atol=1e-12)
