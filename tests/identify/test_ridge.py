"""Ridge regression on coloured residuals: the covariance is as large as the errors are."""

from __future__ import annotations

import numpy as np

from armlab.identify.drives.regularised import held_out_error, refit, ridge_solution, scattered


def test_the_covariance_of_a_refit_is_true() -> None:
    """Scatter of 200 refits of one problem with residuals that remember."""
    rng = np.random.default_rng(3)
    A, truth, block = rng.standard_normal((2000, 3)), np.array([1.0, -2.0, 0.5]), np.arange(2000) // 20
    found = []
    for _ in range(200):
        e = np.repeat(rng.standard_normal(200), 10) + 0.1 * rng.standard_normal(2000)
        found.append(refit(A, A @ truth + e, block))
    errors = np.array([x - truth for x, _ in found])
    nees = np.mean([e @ np.linalg.solve(cov, e) for e, (_, cov) in zip(errors, found)]) / 3
    assert 0.8 < nees < 1.25
    assert held_out_error(A, A @ truth, block) < 1e-6


def test_few_blocks_leave_no_direction_without_spread() -> None:
    """32 coefficients and 20 blocks of residuals that remember: the scatter alone would have rank 20."""
    rng = np.random.default_rng(4)
    A, block = np.repeat(rng.standard_normal((200, 32)), 10, axis=0), np.arange(2000) // 100
    A = A + 0.5 * rng.standard_normal(A.shape)
    nees = []
    for _ in range(15):
        e = np.repeat(rng.standard_normal(200), 10) + 0.1 * rng.standard_normal(2000)
        x, cov = refit(A, e, block)
        nees.append(x @ np.linalg.solve(cov, x) / 32)
    assert np.linalg.matrix_rank(cov) == 32
    assert 0.7 < np.mean(nees) < 1.4


def test_the_scatter_of_many_stretches_is_that_of_least_squares_in_any_unit() -> None:
    """White residuals: the sandwich is the formal covariance; a parameter in thousandths has a thousandth deviation."""
    rng = np.random.default_rng(4)
    A, noise = rng.standard_normal((20000, 3)), rng.standard_normal(20000)
    cov = scattered(A.T @ A, A * noise[:, None])
    np.testing.assert_allclose(cov, np.linalg.inv(A.T @ A), atol=0.05 / 20000)
    unit = np.array([1.0, 1e3, 1e-3])
    B = A * unit
    np.testing.assert_allclose(scattered(B.T @ B, B * noise[:, None]), cov / np.outer(unit, unit), rtol=1e-6)


def test_the_ridge_solves_its_equations_and_is_relative() -> None:
    rng = np.random.default_rng(6)
    A, y = rng.standard_normal((50, 4)), rng.standard_normal(50)
    x, H = ridge_solution(A, y, 0.1)
    np.testing.assert_allclose(H, A.T @ A + 0.1 * np.mean(np.sum(A**2, axis=0)) * np.eye(4), rtol=1e-12)
    np.testing.assert_allclose(H @ x, A.T @ y, rtol=1e-12)
    np.testing.assert_allclose(ridge_solution(1e3 * A, 1e3 * y, 0.1)[0], x, rtol=1e-12)
