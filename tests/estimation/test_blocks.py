"""Block sums, the block bootstrap, and how many samples a coloured record is worth."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import NotExcited, ShapeError
from armlab.estimation import BlockSums, accumulate, block_bootstrap, correlation_time, effective_samples

RHO = 0.95


def ar1(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    """AR(1) records along axis 0 with unit variance."""
    from scipy.signal import lfilter

    noise = rng.standard_normal((shape[0] + 200, shape[1])) * np.sqrt(1 - RHO**2)
    return lfilter([1.0], [1.0, -RHO], noise, axis=0)[200:]


def problem(rng: np.random.Generator, N: int, coloured: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    theta = np.array([1.0, -2.0, 1e3])
    A = ar1(rng, (N, 3)) * [1.0, 10.0, 1e-3]
    noise = ar1(rng, (N, 1)) if coloured else rng.standard_normal((N, 1))
    return theta, A[:, None, :], A[:, None, :] @ theta + noise


def test_accumulate_gives_block_sums_whose_solution_is_that_of_lstsq() -> None:
    _, A, y = problem(np.random.default_rng(1), 600, coloured=False)
    sums = accumulate(A, y, np.arange(600) // 60)
    assert isinstance(sums, BlockSums)
    assert sums.rows.tolist() == [60] * 10
    np.testing.assert_allclose(sums.solve(), np.linalg.lstsq(A[:, 0], y[:, 0], rcond=None)[0], rtol=1e-9)
    left_out = np.arange(10) != 3
    rows = np.repeat(left_out, 60)
    np.testing.assert_allclose(
        sums.solve(left_out.astype(float)), np.linalg.lstsq(A[rows, 0], y[rows, 0], rcond=None)[0], rtol=1e-9
    )
    assert sums.power.sum() == pytest.approx(np.sum(y**2))


@pytest.mark.parametrize(("coloured", "formal_is_honest"), [(False, True), (True, False)])
def test_block_bootstrap_matches_the_scatter_where_the_formal_covariance_does_not(
    coloured: bool, formal_is_honest: bool
) -> None:
    """NEES over seeds: about 1 per parameter for the bootstrap, more than 3 for the formal one of AR(1) noise."""
    nees, formal = [], []
    for seed in range(60):
        theta, A, y = problem(np.random.default_rng(seed), 6000, coloured)
        sums = accumulate(A, y, np.arange(6000) // 200)
        estimate = sums.solve()
        error = estimate - theta
        cov = np.cov(block_bootstrap(sums, 200, seed), rowvar=False)
        nees.append(error @ np.linalg.solve(cov, error) / 3)
        gram = sums.gram.sum(axis=0)
        formal.append(error @ gram @ error / 3)
    assert 0.7 < np.mean(nees) < 1.5
    assert (np.mean(formal) < 1.4) == formal_is_honest
    if not formal_is_honest:
        assert np.mean(formal) > 3.0


def test_a_parameter_that_only_one_block_sees_is_not_drawn_again() -> None:
    _, A, y = problem(np.random.default_rng(1), 1000, coloured=False)
    A[100:, 0, 1] = 0.0
    with pytest.raises(NotExcited, match="10 blocks"):
        block_bootstrap(accumulate(A, y, np.arange(1000) // 100))


def test_correlation_time_and_effective_samples_of_known_processes() -> None:
    x = ar1(np.random.default_rng(0), (200_000, 1))[:, 0]
    exact = 0.004 * (0.5 + RHO / (1 - RHO))
    assert correlation_time(x, 0.004) == pytest.approx(exact, rel=0.1)
    assert effective_samples(x) == pytest.approx(len(x) * 0.002 / exact, rel=0.1)
    white = np.random.default_rng(0).standard_normal(50_000)
    assert effective_samples(white) == pytest.approx(50_000, rel=0.05)
    assert correlation_time(np.zeros(100), 0.01) == 0.005


def test_bad_input_is_refused() -> None:
    with pytest.raises(ShapeError, match=r"Expected A \(N, k, d\)"):
        accumulate(np.zeros((4, 2)), np.zeros((4, 2)), np.zeros(4, dtype=int))
    _, A, y = problem(np.random.default_rng(1), 100, coloured=False)
    with pytest.raises(ShapeError, match="at least 8 blocks"):
        block_bootstrap(accumulate(A, y, np.arange(100) // 50))
