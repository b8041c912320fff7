"""Least squares with a gain per joint: the minimum, its response, and drawing blocks again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab.estimation import Rows, least_squares
from armlab.identify.solve import GainProblem

X = np.array([2.0, -1.0, 0.5])
NAMES = ("a", "b", "c")


def problem(gains: np.ndarray, gain_sd: float = 0.05, seed: int = 0, noise: float = 0.01):
    rng = np.random.default_rng(seed)
    N, n = 400, len(gains)
    A = rng.standard_normal((N, n, 3))
    y = (1 + gains) * (A @ X) + noise * rng.standard_normal((N, n))
    found = least_squares(list(Rows.of(A, y, np.arange(N) // 20)), NAMES)
    made = GainProblem.of(found, y - A @ found.x, np.zeros(n), gain_sd)
    return A, y, found, made


def test_without_gains_it_is_least_squares() -> None:
    A, y, _, made = problem(np.zeros(4), gain_sd=0.0)
    x, g = made.solve()
    root = np.sqrt(made.weights)
    expected = np.linalg.lstsq((A * root[:, None]).reshape(-1, 3), (y * root).ravel(), rcond=None)[0]
    np.testing.assert_allclose(x, expected, atol=1e-9)
    np.testing.assert_array_equal(g, 0.0)


def test_it_is_the_minimum_of_the_cost() -> None:
    gains = np.array([0.04, -0.03, 0.02, -0.05])
    A, y, _, made = problem(gains)
    x, g = made.solve()

    def cost(x: np.ndarray, g: np.ndarray) -> float:
        r = y - (1 + g) * (A @ x)
        return float(np.sum(made.weights * r * r) + np.sum(g * g) / 0.05**2)

    least = cost(x, g)
    rng = np.random.default_rng(1)
    for step in 1e-4 * rng.standard_normal((50, 7)):
        assert cost(x + step[:3], g + step[3:]) > least
    np.testing.assert_allclose(g - g.mean(), gains - gains.mean(), atol=2e-3)  # their mean is the prior's


def test_the_response_is_the_derivative() -> None:
    A, y, _, made = problem(np.array([0.04, -0.03, 0.02, -0.05]), noise=1e-3)
    x, g = made.solve()
    push = 1e-2 * np.random.default_rng(2).standard_normal(y.shape)
    sums = made.sums.copy()
    for i in range(4):
        for b in range(20):
            rows = slice(20 * b, 20 * b + 20)
            change = made.weights[i] * A[rows, i].T @ push[rows, i]
            sums[b, i, :3, 3] += change
            sums[b, i, 3, :3] += change
    moved = replace(made, sums=sums).solve()[0]
    pushed = made.weights[:, None] * np.einsum("kia,ki->ia", A, push)
    expected = np.einsum("iab,ib->a", made.response(x, g), pushed)
    assert np.linalg.norm(moved - x - expected) < 0.03 * np.linalg.norm(expected)  # second derivatives are left out


def test_the_covariance_is_that_of_the_errors() -> None:
    """Over many draws of noise and gains."""
    nees = []
    for seed in range(60):
        gains = 0.05 * np.random.default_rng([1, seed]).standard_normal(4)
        made = problem(gains, seed=seed, noise=0.3)[3]
        x, g = made.solve()
        nees.append((x - X) @ np.linalg.solve(made.covariance(x, g), x - X) / 3)
    assert np.mean(nees) == pytest.approx(1.0, abs=3 * np.sqrt(2 / (3 * 60)))


def test_the_gains_err_as_their_covariance_says() -> None:
    nees = []
    for seed in range(60):
        gains = 0.05 * np.random.default_rng([1, seed]).standard_normal(4)
        made = problem(gains, seed=seed, noise=0.3)[3]
        x, g = made.solve()
        nees.append((g - gains) @ np.linalg.solve(made.gain_covariance(x, g), g - gains) / 4)
    assert np.mean(nees) == pytest.approx(1.0, abs=3 * np.sqrt(2 / (4 * 60)))


def test_exact_measurements_are_solved() -> None:
    """Without noise a joint would seem to know its gain infinitely well."""
    _, _, _, made = problem(np.array([0.04, -0.03, 0.02, -0.05]), noise=0.0)
    x, g = made.solve()
    np.testing.assert_allclose(np.outer(1 + g, x), np.outer([1.04, 0.97, 1.02, 0.95], X), rtol=1e-3)
    information = made.information(x, g)
    assert np.linalg.eigvalsh(information).min() > 0
    assert x @ information @ x == pytest.approx(4 / 0.05**2, rel=0.1)  # its length is known by four gains of 5 %
