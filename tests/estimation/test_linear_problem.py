"""Solving a linear problem: priors, bounds, unidentified directions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from armlab.errors import NotExcited
from armlab.estimation import (
    ActiveBound,
    LinearProblem,
    LinearSolution,
    Prior,
    Rows,
    factorise,
    least_squares,
    solve,
    within_bounds,
)

BLOCKS = 30


def rows(A: np.ndarray, y: np.ndarray) -> list[Rows]:
    return list(Rows.of(A, y, np.arange(len(y)) * BLOCKS // len(y)))


def test_bounds_hold_and_say_what_they_cost(problems) -> None:
    A, y = problems.draw(3, 400)
    free = least_squares(rows(A, y), problems.names)
    lower = np.array([1.5, -np.inf, 0.0])
    found = least_squares(rows(A, y), problems.names, lower=lower)
    assert found.x[0] == 1.5
    assert [a.name for a in found.active] == ["mass"]
    assert isinstance(found.active[0], ActiveBound)
    assert found.active[0].free == pytest.approx(free.x[0], rel=1e-3)
    assert "mass held at its bound 1.5; without it" in found.active[0].text()
    rms = [np.sqrt(np.mean((y - A @ s.x) ** 2)) for s in (free, found)]
    assert found.growth == pytest.approx(rms[1] / rms[0] - 1.0, rel=1e-6)
    assert free.active == ()
    assert free.growth == 0.0
    assert found.cov[0, 0] > 0  # a bound is no measurement
    np.testing.assert_array_equal(least_squares(rows(A, y), problems.names, lower=np.full(3, -1e4)).x, free.x)


def test_what_the_data_do_not_tell_is_refused_by_name_or_held_by_a_prior(problems) -> None:
    A, y = problems.draw(4, 400)
    A = np.concatenate([A, A[:, :, :1] * 2.0], axis=2)  # a parameter that only its sum with mass is told
    names = (*problems.names, "load")
    with pytest.raises(NotExcited, match=r"mass and load|load and mass"):
        least_squares(rows(A, y), names)
    prior = Prior(np.array([0.5, 0.0, 0.0, 0.2]), np.array([0.3, 1.0, 1.0, 0.1]))
    found = least_squares(rows(A, y), names, prior=prior)
    assert len(found.excitation.held) == 1
    assert "held by the prior: " in found.excitation.text()
    assert found.basis.shape == (4, 3)
    np.testing.assert_allclose(found.x[0] + 2 * found.x[3], 1.0, atol=0.2)  # told by the data
    hidden = found.excitation.vectors[:, 3] * found.excitation.scale
    np.testing.assert_allclose(hidden @ found.x, hidden @ prior.values, rtol=1e-9)
    np.testing.assert_allclose(hidden @ found.cov @ hidden, np.sum((hidden * prior.sd) ** 2), rtol=1e-6)
    bounded = least_squares(rows(A, y), names, prior=prior, lower=np.array([-np.inf, -np.inf, -np.inf, 0.3]))
    assert bounded.x[3] == 0.3
    np.testing.assert_allclose(bounded.x[0] + 2 * bounded.x[3], found.x[0] + 2 * found.x[3], rtol=0.05)


def test_one_pass_serves_any_weights(problems) -> None:
    A, y = problems.draw(6, 300, k=2)
    factors = factorise(iter(rows(A, y)), 3)
    question = LinearProblem.of(problems.names, "model")
    assert isinstance(solve(question, factors), LinearSolution)
    found = solve(question, factors, np.array([3.0, 1.0]), kept=np.arange(BLOCKS) != 4)
    keep = np.arange(300) * BLOCKS // 300 != 4
    w = np.tile([3.0, 1.0], keep.sum())[:, None]
    dense = np.linalg.lstsq(A[keep].reshape(-1, 3) * w, y[keep].ravel() * w[:, 0], rcond=None)[0]
    np.testing.assert_allclose(found.x, dense, rtol=1e-12)
    assert not found.kept[4]


# Bounds: the same point as a reference solver, on the bound exactly.


@pytest.mark.parametrize("seed", range(60))
def test_within_bounds_agrees_with_bounded_least_squares(seed: int) -> None:
    rng = np.random.default_rng(seed)
    p = int(rng.integers(1, 25))
    A = rng.standard_normal((p + 5, p)) @ np.diag(10.0 ** rng.uniform(-3, 3, p))
    x = rng.standard_normal(p) / np.linalg.norm(A, axis=0)
    width = rng.uniform(0.1, 1.0, p) / np.linalg.norm(A, axis=0)
    low, high = rng.random((2, p)) < 0.3
    lower = np.where(low, -np.inf, -0.7 * width)
    upper = np.where(high, np.inf, 0.3 * width)
    R = np.linalg.qr(A, mode="r")
    root = np.linalg.inv(R)
    found = within_bounds(x, root @ root.T, lower, upper)
    scale = np.linalg.norm(R, axis=0)
    reference = lsq_linear(R / scale, R @ x, (lower * scale, upper * scale), method="bvls", tol=1e-14).x / scale
    assert np.all((found >= lower) & (found <= upper))
    np.testing.assert_allclose(found * scale, reference * scale, atol=1e-7)
