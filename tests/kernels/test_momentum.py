"""The momentum filter: its discretisation against the matrix exponential, its limits, and its honesty."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from armlab import robots
from armlab.errors import ShapeError
from armlab.kernels import _reference, backend, momentum_step, solve_wrench
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
@settings(max_examples=60)
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
    """No leak, a constant torque error, velocity known: the steady wrench is prior-free least squares, weights 1/Qp.

    The velocity is known exactly, R = 0: with R = 1e-12 (N m s)^2 the wrench is off by 1e-6.
    """
    robot = robots.load("yumi_left")
    rng = np.random.default_rng(1)
    J = robot.chain.jacobian(robot.q_home)
    tau_e, Qp = rng.standard_normal(7), rng.uniform(0.5, 2, 7) * 1e-3
    x, P = np.zeros(13), np.diag(np.r_[np.zeros(7), [400.0] * 3, [4.0] * 3])
    p = np.zeros(7)
    for _ in range(1500):  # the slowest mode, of the smallest intensity, keeps 0.980 per step
        p = p + H * tau_e
        x, P = momentum_step(
            x, P, J.T, np.zeros(7), p, np.zeros((7, 7)), H, Qp, intensity**2 * np.array([1, 1, 1, 0.01, 0.01, 0.01]),
            np.zeros(6),
        )  # fmt: skip
    weighted = J / Qp
    expected = np.linalg.solve(weighted @ J.T, weighted @ tau_e)
    np.testing.assert_allclose(x[7:], expected, rtol=1e-8)


def test_a_wrench_held_over_one_step_is_the_static_estimate() -> None:
    """Momentum known, R -> 0, a fresh wrench N(0, C_F) acting during the step: MAP with C_tau = Qp / h, to 1e-9."""
    robot, rng = robots.load("yumi_left"), np.random.default_rng(4)
    prior, scale = np.r_[[400.0] * 3, [4.0] * 3], np.r_[[20.0] * 3, [2.0] * 3]
    for q in rng.uniform(robot.q_min, robot.q_max, (20, 7)):
        J, Qp = robot.chain.jacobian(q), rng.uniform(0.5, 2, 7) * 1e-3
        u, tau_e = rng.standard_normal((2, 7))
        p = H * (u + tau_e)
        x, P = momentum_step(
            np.zeros(13), np.diag(np.r_[np.zeros(7), np.ones(6)]), J.T * scale, u, p, np.zeros((7, 7)), H, Qp,
            np.zeros(6), np.zeros(6),
        )  # fmt: skip
        F, cov, *_ = solve_wrench(J, tau_e, Qp / H, np.zeros(7), prior, 0)
        np.testing.assert_allclose(scale * x[7:], F, rtol=0, atol=1e-9 * np.abs(F).max())
        np.testing.assert_allclose(np.outer(scale, scale) * P[7:, 7:], cov, rtol=0, atol=1e-9 * cov.max())


def test_external_torques_in_place_of_the_wrench_make_the_observer() -> None:
    """With G = 1 and the gain of the steady state, ``z <- z + k ((p - p_before) - h (u + z))``, to 1e-9."""
    rng = np.random.default_rng(5)
    n, R = 3, np.zeros((3, 3))
    arguments = np.eye(n), H, np.full(n, 1e-2), np.full(n, 20.0), np.zeros(n)
    x, P = np.zeros(2 * n), np.eye(2 * n)

    def step(x: np.ndarray, P: np.ndarray, u: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        G, h, Qp, q, a = arguments
        return momentum_step(x, P, G, u, y, R, h, Qp, q, a)

    for _ in range(2000):
        x, P = step(x, P, np.zeros(n), np.zeros(n))
    gain = step(np.zeros(2 * n), P, np.zeros(n), np.ones(n))[0][n:]
    p, r = np.zeros(n), np.zeros(n)
    x = np.zeros(2 * n)
    for _ in range(200):
        u, y = rng.standard_normal((2, n))
        x, P = step(x, P, u, y)
        r, p = r + gain * ((y - p) - H * (u + r)), y
        np.testing.assert_allclose(x[n:], r, rtol=0, atol=1e-9 * np.abs(r).max())


def test_its_covariance_is_that_of_its_errors() -> None:
    """NEES of a wrench that walks at random, torque and velocity noise being what the filter is told: 0.95 to 1.05."""
    robot = robots.load("yumi_left")
    rng = np.random.default_rng(2)
    J = robot.chain.jacobian(robot.q_home)
    Qp, R, q = np.full(7, 4e-3), 1e-6 * np.eye(7), np.r_[np.full(3, 25.0), np.full(3, 0.25)]
    Phi, Q = van_loan(J.T, Qp, q, np.zeros(6), H)
    root, start = np.linalg.cholesky(Q + 1e-18 * np.eye(13)), np.r_[np.full(7, 1e-6), [400.0] * 3, [4.0] * 3]
    nees = []
    for _ in range(300 if backend == "native" else 60):
        x, P, true = np.zeros(13), np.diag(start), np.sqrt(start) * rng.standard_normal(13)
        for k in range(1, 121):
            true = Phi @ true + root @ rng.standard_normal(13)
            y = true[:7] + 1e-3 * rng.standard_normal(7)
            x, P = momentum_step(x, P, J.T, np.zeros(7), y, R, H, Qp, q, np.zeros(6))
            if k % 60 == 0:
                error = x[7:] - true[7:]
                nees.append(error @ np.linalg.solve(P[7:, 7:], error) / 6)
    assert abs(np.mean(nees) - 1) < (0.05 if backend == "native" else 0.15)


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
