"""The momentum filter: its discretisation against the matrix exponential, its limits, and its honesty."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from armlab import robots
from armlab.errors import ShapeError
from armlab.kernels import _reference, momentum_step
from armlab.kernels._reference.momentum import leak_integrals

H = 0.004


def van_loan(G: np.ndarray, Qp: np.ndarray, q: np.ndarray, a: np.ndarray, h: float) -> tuple[np.ndarray, np.ndarray]:
    """Transition and noise of a step by the block exponential (Van Loan 1978)."""
    n, m = G.shape
    A = np.block([[np.zeros((n, n)), G], [np.zeros((m, n)), -np.diag(a)]])
    Q = np.diag(np.r_[Qp, q])
    block = expm(np.block([[-A, Q], [np.zeros_like(A), A.T]]) * h)
    Phi = block[n + m :, n + m :].T
    return Phi, Phi @ block[: n + m, n + m :]


@given(st.integers(0, 2**32), st.sampled_from([0.0, 1e-9, 1e-3, 0.5, 4.9, 5.1, 80.0, 900.0]), st.booleans())
@settings(max_examples=60, deadline=None)
def test_a_step_without_information_is_van_loans(seed: int, leak: float, mixed: bool) -> None:
    """A measurement that says nothing leaves the prediction: transition and noise to 1e-12 of their scale."""
    rng = np.random.default_rng(seed)
    n, m = 4, 3
    G, Qp, q = rng.standard_normal((n, m)), rng.uniform(0.1, 1, n), rng.uniform(0.1, 1, m)
    a = np.where(rng.random(m) < 0.5, 0.0, leak) if mixed else np.full(m, leak)
    x, root = rng.standard_normal(n + m), rng.standard_normal((n + m, n + m))
    P, u = root @ root.T, rng.standard_normal(n)
    Phi, Q = van_loan(G, Qp, q, a, H)
    moved = Phi @ x
    moved[:n] += H * u
    new_x, new_P = momentum_step(x, P, G, u, moved[:n], np.eye(n) * 1e15, H, Qp, q, a)
    np.testing.assert_allclose(new_x, moved, rtol=0, atol=1e-12 * np.abs(moved).max())
    np.testing.assert_allclose(new_P, Phi @ P @ Phi.T + Q, rtol=0, atol=1e-12 * np.abs(new_P).max())
    quiet = _reference.momentum_step(x, 0 * P, G, u, moved[:n], np.eye(n) * 1e15, H, Qp, q, a)[1]
    np.testing.assert_allclose(quiet, Q, rtol=1e-9, atol=1e-18)


def test_the_series_meets_the_closed_form() -> None:
    below, above = (leak_integrals(np.array([a]), 1.0)[4][0] for a in (0.02 * (1 - 1e-9), 0.02 * (1 + 1e-9)))
    assert below == pytest.approx(above, rel=1e-9)


@pytest.mark.parametrize("intensity", [2.0, 20.0, 200.0])
def test_held_torques_give_weighted_least_squares(intensity: float) -> None:
    """No leak, a constant torque error, velocity known: the steady wrench is prior-free least squares, weights 1/Qp."""
    robot = robots.load("yumi_left")
    rng = np.random.default_rng(1)
    J = robot.chain.jacobian(robot.q_home)
    tau_e, Qp = rng.standard_normal(7), rng.uniform(0.5, 2, 7) * 1e-3
    x, P = np.zeros(13), np.diag(np.r_[np.zeros(7), [400.0] * 3, [4.0] * 3])
    p = np.zeros(7)
    for _ in range(6000):
        p = p + H * tau_e
        x, P = momentum_step(
            x, P, J.T, np.zeros(7), p, 1e-12 * np.eye(7), H, Qp, intensity**2 * np.array([1, 1, 1, 0.01, 0.01, 0.01]),
            np.zeros(6),
        )  # fmt: skip
    weighted = J / Qp
    expected = np.linalg.solve(weighted @ J.T, weighted @ tau_e)
    np.testing.assert_allclose(x[7:], expected, rtol=1e-6, atol=1e-7)


def test_its_covariance_is_that_of_its_errors() -> None:
    """NEES of the wrench: it walks at random, torque and velocity noise are what the filter is told."""
    robot = robots.load("yumi_left")
    rng = np.random.default_rng(2)
    J = robot.chain.jacobian(robot.q_home)
    Qp, R, q = np.full(7, 4e-3), 1e-6 * np.eye(7), np.r_[np.full(3, 25.0), np.full(3, 0.25)]
    nees, fine = [], 20
    for _ in range(60):
        x, P = np.zeros(13), np.diag(np.r_[np.full(7, 1e-6), [400.0] * 3, [4.0] * 3])
        F, p = np.sqrt(np.r_[[400.0] * 3, [4.0] * 3]) * rng.standard_normal(6), 1e-3 * rng.standard_normal(7)
        for _ in range(120):
            for _ in range(fine):
                p = p + (J.T @ F) * (H / fine) + np.sqrt(Qp * H / fine) * rng.standard_normal(7)
                F = F + np.sqrt(q * H / fine) * rng.standard_normal(6)
            y = p + 1e-3 * rng.standard_normal(7)
            x, P = momentum_step(x, P, J.T, np.zeros(7), y, R, H, Qp, q, np.zeros(6))
        error = x[7:] - F
        nees.append(error @ np.linalg.solve(P[7:, 7:], error) / 6)
    assert abs(np.mean(nees) - 1) < 3 * np.sqrt(2 / (6 * 60))


def test_the_covariance_stays_symmetric_and_positive() -> None:
    rng = np.random.default_rng(3)
    x, P = np.zeros(13), np.diag(np.r_[np.full(7, 1e-8), [400.0] * 3, [4.0] * 3])
    for _ in range(20_000):
        G = rng.standard_normal((7, 6))
        x, P = momentum_step(
            x, P, G, rng.standard_normal(7), rng.standard_normal(7), 1e-10 * np.eye(7), H, np.full(7, 1e-3),
            np.full(6, 25.0), np.full(6, 0.5),
        )  # fmt: skip
    assert np.array_equal(P, P.T)
    assert np.linalg.eigvalsh(P).min() > 0


def test_wrong_shapes_and_no_noise_are_refused() -> None:
    good = {
        "x": np.zeros(3), "P": np.zeros((3, 3)), "G": np.ones((2, 1)), "u": np.zeros(2), "y": np.zeros(2),
        "R": np.zeros((2, 2)), "h": H, "Qp": np.zeros(2), "q": np.zeros(1), "a": np.zeros(1),
    }  # fmt: skip
    with pytest.raises(ShapeError, match="positive covariance"):
        momentum_step(**good)
    for name in ("x", "P", "u", "y", "R", "Qp", "q", "a"):
        with pytest.raises(ShapeError, match=name):
            momentum_step(**{**good, name: np.zeros(9)})
        with pytest.raises(ShapeError, match=f"^Expected {name} to be an array of real numbers, got NoneType"):
            momentum_step(**{**good, name: None})
