"""Block bootstrap, cross-validation and residual autocorrelation."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import NotExcited
from armlab.estimation import BlockSums, Prior, Rows, block_bootstrap, block_cv, least_squares
from armlab.estimation.robust import Bootstrap, CrossValidation, block_seconds, correlation_time, effective_samples


def sums(A: np.ndarray, y: np.ndarray, names, blocks: int, **options) -> BlockSums:
    rows = list(Rows.of(A, y, np.arange(len(y)) * blocks // len(y)))
    return BlockSums.of(least_squares(rows, names, **{"method": "ols", **options}))


def test_block_sums_are_orthonormal_and_solve_any_part(problems) -> None:
    A, y = problems.draw(1, 600)
    found = sums(A, y, problems.names, 10)
    np.testing.assert_allclose(found.gram.sum(axis=0), np.eye(3), atol=1e-12)
    np.testing.assert_allclose(found.moment.sum(axis=0), 0.0, atol=1e-11)
    assert found.power.sum() == pytest.approx(np.sum((y - A @ found.solution.x) ** 2))
    left_out = np.arange(10) != 3
    keep = np.repeat(left_out, 60)
    dense = np.linalg.lstsq(A[keep, 0], y[keep, 0], rcond=None)[0]
    np.testing.assert_allclose(found.solve(left_out), dense, rtol=1e-11)
    assert found.solve(np.ones((2, 5, 10))).shape == (2, 5, 3)


@pytest.mark.parametrize(("coloured", "formal_is_honest"), [(False, True), (True, False)])
def test_block_bootstrap_matches_the_scatter_where_the_formal_covariance_does_not(
    coloured: bool, formal_is_honest: bool, problems
) -> None:
    """NEES per parameter over seeds: about 1 for the bootstrap, above 3 for the formal covariance with AR(1) noise."""
    nees, formal, covered = [], [], []
    for seed in range(48):
        A, y = problems.draw(seed, 6000, coloured)
        drawn = block_bootstrap(sums(A, y, problems.names, 120), 200, seed, length=4)
        assert isinstance(drawn, Bootstrap)
        assert drawn.draws.shape == (200, 3)
        assert 0.0 < drawn.shrinkage <= 1.0
        solution = least_squares(Rows.of(A, y, np.zeros(6000, dtype=int)), problems.names)
        error = solution.x - problems.theta
        nees.append(error @ np.linalg.solve(drawn.cov, error) / 3)
        formal.append(error @ np.linalg.solve(solution.cov, error) / 3)
        low, high = drawn.interval(0.95)
        covered.append((low < problems.theta) & (problems.theta < high))
    assert 0.7 < np.mean(nees) < 1.4
    assert 0.88 < np.mean(covered) < 0.99
    assert (np.mean(formal) < 1.4) == formal_is_honest
    if not formal_is_honest:
        assert np.mean(formal) > 3.0


def test_many_parameters_and_few_blocks_have_an_honest_covariance(problems) -> None:
    """Twenty parameters, 30 segments of coloured data: without shrinkage NEES would be above 2."""
    nees, raw = [], []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        A = problems.ar1(rng, (6000, 20))[:, None]
        truth = np.arange(20.0)
        found = sums(A, A @ truth + problems.ar1(rng, (6000, 1)), [f"p{i}" for i in range(20)], 120)
        drawn = block_bootstrap(found, seed=seed, length=4)
        error = found.solution.x - truth
        nees.append(error @ np.linalg.solve(drawn.cov, error) / 20)
        raw.append(error @ np.linalg.solve(np.cov(drawn.draws, rowvar=False), error) / 20)
    assert 0.7 < np.mean(nees) < 1.4
    assert np.mean(raw) > 2.0


def test_block_bootstrap_of_huber_is_as_wide_as_its_scatter(problems) -> None:
    """Fixed weights alone would make the standard deviations 14 % too small."""
    drawn, solutions = [], []
    for seed in range(40):
        A, y = problems.draw(seed, 2000)
        rows = list(Rows.of(A, y, np.arange(2000) // 50))
        solution = least_squares(rows, problems.names, method="irls")
        assert 1.1 < solution.stretch < 1.25
        drawn.append(np.diag(block_bootstrap(BlockSums.of(solution), 200, seed).cov))
        solutions.append(solution.x)
    ratio = np.sqrt(np.mean(drawn, axis=0) / np.var(solutions, axis=0))
    assert np.mean(ratio) == pytest.approx(1.0, abs=0.12)  # standard error 0.06


def test_draws_respect_bounds_and_priors(problems) -> None:
    A, y = problems.draw(2, 1000)
    bounded = block_bootstrap(sums(A, y, problems.names, 20, lower=np.array([1.0, -np.inf, -np.inf])), 200)
    assert np.all(bounded.draws[:, 0] >= 1.0)
    assert np.any(bounded.draws[:, 0] > 1.0)
    doubled = np.concatenate([A, A[:, :, :1]], axis=2)
    prior = Prior(np.array([0.5, 0, 0, 0.5]), np.full(4, 0.1))
    held = block_bootstrap(sums(doubled, y, (*problems.names, "load"), 20, prior=prior), 200)
    assert np.linalg.eigvalsh(held.cov)[0] > 0
    assert held.cov[3, 3] > 0.004


def test_spread_counts_the_blocks_that_tell_a_parameter() -> None:
    """All ten blocks determine parameter a, one determines b, and half of them c; a prior holds d."""
    A = np.zeros((1000, 1, 4))
    x = np.random.default_rng(0).standard_normal((1000, 3))
    block = np.arange(1000) // 100
    A[:, 0, :3] = x * np.stack([np.ones(1000), block == 3, block % 2 == 0], axis=1)
    prior = Prior(np.zeros(4), np.ones(4))
    found = sums(A, x.sum(axis=1, keepdims=True), ("a", "b", "c", "d"), 10, prior=prior)
    np.testing.assert_allclose(found.spread()[:3], [10.0, 1.0, 5.0], rtol=0.1)
    assert found.spread()[3] == np.inf
    np.testing.assert_allclose(found.spread(2)[:3], [5.0, 1.0, 5.0], rtol=0.1)


def test_a_parameter_that_only_one_block_sees_is_not_drawn_again(problems) -> None:
    A, y = problems.draw(1, 1000)
    A[100:, 0, 1] = 0.0
    with pytest.raises(NotExcited, match="10 blocks"):
        block_bootstrap(sums(A, y, problems.names, 10))


def test_block_cv_scores_rows_that_the_solution_did_not_see(problems) -> None:
    A, y = problems.draw(5, 1400, k=2)
    y[:, 1] = 10.0 * y[:, 1] - 9.0 * A[:, 1] @ problems.theta
    found = block_cv(sums(A, y, problems.names, 28, method="wls"), folds=7)
    assert isinstance(found, CrossValidation)
    assert found.fold.tolist() == np.repeat(np.arange(7), 4).tolist()
    assert found.rms.shape == (7, 2)
    fold = np.repeat(found.fold, 50)
    residual = (y - A @ found.solutions[2])[fold == 2]
    np.testing.assert_allclose(found.rms[2], np.sqrt(np.mean(residual**2, axis=0)), rtol=1e-10)
    np.testing.assert_allclose(found.rms.mean(axis=0), [1.0, 10.0], rtol=0.1)
    turns = block_cv(sums(A, y, problems.names, 28), folds=2, mode="alternate")
    assert turns.fold.tolist() == [0, 1] * 14
    odd = np.repeat(turns.fold, 50) == 1
    dense = np.linalg.lstsq(A[~odd].reshape(-1, 3), y[~odd].ravel(), rcond=None)[0]
    np.testing.assert_allclose(turns.solutions[1], dense, rtol=1e-10)


def test_blocks_that_are_trimmed_are_not_drawn(problems) -> None:
    A, y = problems.draw(6, 3000)
    y[900:1000] += 50.0
    found = sums(A, y, problems.names, 30, method="lts")
    assert found.rows[9] == 0
    assert block_cv(found, 5).fold[9] == -1
    assert np.max(np.abs(block_bootstrap(found, 200).draws[:, 1] + 2.0)) < 0.05


RHO = 0.95  # of the AR(1) records of conftest


def test_correlation_time_and_effective_samples_of_known_processes(problems) -> None:
    x = problems.ar1(np.random.default_rng(0), (100_000, 1))[:, 0]
    exact = 0.004 * (0.5 + RHO / (1 - RHO))
    assert correlation_time(x, 0.004) == pytest.approx(exact, rel=0.1)
    assert effective_samples(x) == pytest.approx(len(x) * 0.002 / exact, rel=0.1)
    white = np.random.default_rng(0).standard_normal(50_000)
    assert effective_samples(white) == pytest.approx(50_000, rel=0.05)
    assert correlation_time(np.zeros(100), 0.01) == 0.005


def test_block_seconds_follow_the_longest_memory(problems) -> None:
    rng = np.random.default_rng(0)
    white = rng.standard_normal((50_000, 1))
    slow = problems.ar1(rng, (50_000, 1))
    assert block_seconds(white, 0.004) == 0.5
    assert block_seconds(np.hstack([white, slow]), 0.1) == 4.0 * correlation_time(slow[:, 0], 0.1)
