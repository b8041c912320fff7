"""Total least squares."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import NotExcited, ShapeError
from armlab.estimation import TotalSolution, total_least_squares

TRUTH = np.array([1.5, -0.8, 0.4])


def rows(seed: int, n: int = 100, sigma: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    """Errors of one deviation in two columns and in y; the third column is an offset."""
    rng = np.random.default_rng([3, seed])
    A = np.column_stack([rng.standard_normal((n, 2)), np.ones(n)])
    y = A @ TRUTH
    A[:, :2] += sigma * rng.standard_normal((n, 2))
    return A, y + sigma * rng.standard_normal(n)


def test_exact_rows() -> None:
    A, y = rows(0, sigma=0.0)
    for found in (
        total_least_squares(A, y, exact=[2]),
        total_least_squares(A, y),
        total_least_squares(A, y, cov=np.diag([1.0, 1, 0, 1]) * 1e-4),
    ):
        np.testing.assert_allclose(found.x, TRUTH, rtol=0, atol=1e-12)
    assert isinstance(found, TotalSolution)


def test_the_corrected_rows_agree() -> None:
    A, y = rows(1)
    found = total_least_squares(A, y, exact=[2])
    fixed = np.column_stack([A, y]) - found.corrections
    np.testing.assert_allclose(fixed @ np.append(found.x, -1.0), 0.0, atol=1e-12)
    np.testing.assert_array_equal(found.corrections[:, 2], 0.0)
    assert found.sigma == pytest.approx(0.1, rel=0.2)


def test_weighted_is_plain_where_weights_are_equal() -> None:
    A, y = rows(2)
    plain = total_least_squares(A, y, exact=[2])
    one = np.diag([1.0, 1, 0, 1]) * plain.sigma**2
    for cov in (one, np.broadcast_to(one, (len(A), 4, 4))):
        found = total_least_squares(A, y, cov=cov)
        np.testing.assert_allclose(found.x, plain.x, rtol=0, atol=1e-10)
        np.testing.assert_allclose(found.cov, plain.cov, rtol=1e-6)
        np.testing.assert_allclose(found.corrections, plain.corrections, atol=1e-9)
        assert found.sigma == pytest.approx(1.0)


def test_no_bias_and_honest_covariance() -> None:
    """Errors of a tenth of the signal: least squares is off by many deviations, this by none. NEES/3 is 1."""
    found = [total_least_squares(*rows(seed), exact=[2]) for seed in range(150)]
    e = np.array([one.x - TRUTH for one in found])
    mean = np.linalg.inv(found[0].cov)
    assert e.mean(axis=0) @ mean @ e.mean(axis=0) * len(e) < 16.3  # 99.9 % of chi^2 with 3
    nees = np.mean([d @ np.linalg.solve(one.cov, d) / 3 for d, one in zip(e, found, strict=True)])
    assert 0.85 < nees < 1.2
    plain = np.array([np.linalg.lstsq(*rows(seed), rcond=None)[0] - TRUTH for seed in range(300)]).mean(axis=0)
    assert plain @ mean @ plain * len(e) > 50


def test_weighted_rows_of_their_own_covariance() -> None:
    """Correlated errors of different size: NEES/2 is 1, and better than without weights."""
    errors, plain, nees = [], [], []
    for seed in range(100):
        rng = np.random.default_rng([4, seed])
        n = 60
        root = rng.standard_normal((n, 3, 3)) * rng.uniform(0.01, 0.1, (n, 1, 1))
        A = rng.standard_normal((n, 2))
        Z = np.column_stack([A, A @ TRUTH[:2]]) + np.einsum("nij,nj->ni", root, rng.standard_normal((n, 3)))
        cov = root @ np.swapaxes(root, 1, 2)
        found = total_least_squares(Z[:, :2], Z[:, 2], cov=cov)
        d = found.x - TRUTH[:2]
        errors.append(d @ d)
        nees.append(d @ np.linalg.solve(found.cov, d) / 2)
        other = total_least_squares(Z[:, :2], Z[:, 2]).x - TRUTH[:2]
        plain.append(other @ other)
    assert 0.8 < np.mean(nees) < 1.25
    assert np.sqrt(np.mean(errors) / np.mean(plain)) < 0.7


def test_a_line_is_that_of_the_principal_direction() -> None:
    rng = np.random.default_rng(5)
    p = np.outer(rng.standard_normal(30), [0.6, 0.8]) + 0.01 * rng.standard_normal((30, 2))
    q = p - p.mean(axis=0)
    v = np.linalg.svd(q)[2][0]
    assert total_least_squares(q[:, :1], q[:, 1]).x[0] == pytest.approx(v[1] / v[0], rel=1e-12)


def test_outliers_are_found() -> None:
    A, y = rows(6, sigma=0.01)
    y[[3, 50]] += 2.0
    found = total_least_squares(A, y, cov=np.diag([1.0, 1, 0, 1]) * 1e-4, robust=True)
    assert np.flatnonzero(found.outliers).tolist() == [3, 50]


@pytest.mark.parametrize(
    ("change", "error", "sentence"),
    [
        ({"A": np.ones((5, 3, 1))}, ShapeError, r"A \(N, p\)"),
        ({"y": np.ones(5)}, ShapeError, r"y \(N,\)"),
        ({"y": np.where(np.arange(100) == 7, np.nan, 1.0)}, ShapeError, "rows 7"),
        ({"A": np.ones((3, 3)), "y": np.ones(3)}, NotExcited, "more than 3 rows"),
        ({"A": np.ones((9, 2)), "y": np.arange(9.0)}, NotExcited, "x0 and x1|x1 and x0"),
        ({"exact": [5]}, ShapeError, "exact columns"),
        ({"names": ["a"]}, ShapeError, "3 names"),
        ({"robust": True}, ShapeError, "cov="),
        ({"cov": np.eye(3)}, ShapeError, "cov"),
        ({"cov": -np.eye(4)}, ShapeError, "not negative"),
        ({"cov": np.diag([1.0, 1, 1, 0])}, ShapeError, "variance of y"),
        ({"cov": np.eye(4), "exact": [2]}, ShapeError, "got both"),
    ],
)
def test_bad_input_is_refused(change: dict, error: type[Exception], sentence: str) -> None:
    A, y = rows(0)
    with pytest.raises(error, match=sentence):
        total_least_squares(**{"A": A, "y": y, **change})
