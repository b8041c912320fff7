"""The two-link arm: values of the specification, one mass matrix both ways, energy, elbows, points out of reach."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armlab.errors import ShapeError
from armlab.sim.two_link import (
    ARM,
    TwoLink,
    energy,
    forward,
    forward_dynamics,
    inverse,
    inverse_dynamics,
    jacobian,
    mass_matrix,
    rhs,
)

OTHER = TwoLink(m1=0.7, m2=0.3, l1=0.6, l2=0.9, viscous=0.4, coulomb=0.05, gravity=9.80665)
few = settings(max_examples=20)
angles = st.tuples(*[st.floats(-6.0, 6.0)] * 2).map(np.array)


def test_torque_of_the_specification() -> None:
    tau = inverse_dynamics([0.3, 0.5], [0.1, -0.2], [1.0, 2.0])
    np.testing.assert_allclose(tau, [4.57175678, 1.68536273], atol=5e-9)


@few
@given(q=angles, qd=angles, qdd=angles, arm=st.sampled_from([ARM, OTHER]))
def test_dynamics_undo_each_other(q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, arm: TwoLink) -> None:
    tau = inverse_dynamics(q, qd, qdd, arm)
    np.testing.assert_allclose(forward_dynamics(q, qd, tau, arm), qdd, atol=1e-10)
    np.testing.assert_allclose(rhs(np.concatenate([q, qd]), tau, arm), [*qd, *qdd], atol=1e-10)
    rest = [inverse_dynamics(q, qd, a, arm) - inverse_dynamics(q, qd, [0, 0], arm) for a in ([1, 0], [0, 1])]
    np.testing.assert_allclose(np.transpose(rest), mass_matrix(q, arm), atol=1e-12)


@few
@given(q=angles, qd=angles, tau=angles, arm=st.sampled_from([ARM, OTHER]))
def test_power_is_the_change_of_energy(q: np.ndarray, qd: np.ndarray, tau: np.ndarray, arm: TwoLink) -> None:
    """d/dt E = (tau - friction) . qd, by central differences along the motion."""
    smooth = replace(arm, viscous=0.0, coulomb=0.0)
    h, qdd = 1e-5, forward_dynamics(q, qd, tau, smooth)
    after, before = (energy(q + s * qd + 0.5 * s**2 * qdd, qd + s * qdd, smooth) for s in (h, -h))
    assert (after - before) / (2 * h) == pytest.approx(tau @ qd, abs=1e-4 * (1.0 + np.abs(qdd).max() ** 2))


def test_energy_of_a_free_swing_is_constant() -> None:
    from scipy.integrate import solve_ivp

    arm = replace(ARM, viscous=0.0, coulomb=0.0)
    start = np.array([1.0, 0.5, 0.0, 0.0])
    run = solve_ivp(lambda _, x: rhs(x, [0.0, 0.0], arm), (0.0, 2.0), start, "DOP853", rtol=1e-13, atol=1e-14)
    found = energy(run.y[:2].T, run.y[2:].T, arm)
    assert found[0] == pytest.approx(arm.gravity * (0.4 * (1 - np.cos(1.0)) + 0.2 * (1 - np.cos(1.5))))
    np.testing.assert_allclose(found, found[0], rtol=0, atol=1e-12)
    assert np.ptp(run.y[0]) > 1.5


def test_both_elbows_of_the_specification() -> None:
    np.testing.assert_allclose(inverse([0.5, 0.5]), [1.146765287, 2.418858406], atol=5e-10)
    np.testing.assert_allclose(inverse([0.5, 0.5], "up"), [3.565623693, -2.418858406], atol=5e-10)


@few
@given(q=angles, elbow=st.sampled_from(["down", "up"]), arm=st.sampled_from([ARM, OTHER]))
def test_inverse_reaches_every_point(q: np.ndarray, elbow: Any, arm: TwoLink) -> None:
    p = forward(q, arm)
    found = inverse(p, elbow, arm)
    np.testing.assert_allclose(forward(found, arm), p, atol=1e-7)  # the square root of rounding at the stretched arm
    assert found[1] * (1 if elbow == "down" else -1) >= 0


@pytest.mark.parametrize("p", [[0.0, 0.0], [0.0, 2.0], [0.0, -2.0], [-2.0, 0.0]])
def test_the_rim_is_reached(p: list[float]) -> None:
    np.testing.assert_allclose(forward(inverse(p)), p, atol=1e-12)


@few
@given(q=angles, qd=angles, arm=st.sampled_from([ARM, OTHER]))
def test_jacobian_is_the_derivative(q: np.ndarray, qd: np.ndarray, arm: TwoLink) -> None:
    h = 1e-6
    by_differences = (forward(q + h * qd, arm) - forward(q - h * qd, arm)) / (2 * h)
    np.testing.assert_allclose(jacobian(q, arm) @ qd, by_differences, atol=1e-8)


def test_batches_are_loops() -> None:
    q, qd, u = np.random.default_rng(0).normal(size=(3, 4, 3, 2))
    for one in (mass_matrix, forward, jacobian):
        np.testing.assert_array_equal(one(q), [[one(b) for b in a] for a in q])
    for function in (inverse_dynamics, forward_dynamics):
        loop = [[function(*row) for row in zip(*rows, strict=True)] for rows in zip(q, qd, u, strict=True)]
        np.testing.assert_allclose(function(q, qd, u), loop, atol=1e-14)
    assert rhs(np.concatenate([q, qd], axis=-1), [0.0, 0.0]).shape == (4, 3, 4)
    assert energy(q, qd).shape == (4, 3)


def test_points_out_of_reach_are_named_with_their_distance() -> None:
    with pytest.raises(ShapeError, match=r"between 0 m and 2 m .* got a point at 5 m"):
        inverse([[0.5, 0.5], [3.0, 4.0]])
    with pytest.raises(ShapeError, match=r"between 0\.3 m"):
        inverse([0.1, 0.0], arm=OTHER)
    with pytest.raises(ShapeError, match="Move the point within reach"):
        inverse([np.nan, 0.0])
