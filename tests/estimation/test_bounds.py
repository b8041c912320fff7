"""Bounds: the same point as a reference solver, on the bound exactly."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from armlab.estimation import within_bounds


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


def test_a_point_inside_is_returned_as_it_is() -> None:
    x = np.array([0.1, 0.2])
    np.testing.assert_array_equal(within_bounds(x, np.eye(2), np.zeros(2), np.ones(2)), x)


def test_the_others_follow_their_correlation() -> None:
    cov = np.array([[1.0, 0.5], [0.5, 1.0]])
    found = within_bounds(np.array([-1.0, 3.0]), cov, np.array([0.0, -np.inf]), np.full(2, np.inf))
    np.testing.assert_allclose(found, [0.0, 3.5])
