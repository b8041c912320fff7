"""Linear least squares: triangular factors, methods, priors, bounds."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import scipy.linalg  # noqa: F401  its BLAS is one of those that count
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear
from threadpoolctl import threadpool_info, threadpool_limits

from armlab.errors import NotExcited
from armlab.estimation import Prior, Rows, least_squares
from armlab.estimation.linear_problem import student_factor, within_bounds
from armlab.estimation.robust import METHODS, least_trimmed_squares
from armlab.estimation.tsqr import factorise, one_thread

BLOCKS = 30


def rows(A: np.ndarray, y: np.ndarray) -> list[Rows]:
    return list(Rows.of(A, y, np.arange(len(y)) * BLOCKS // len(y)))


def test_ols_is_that_of_lstsq(problems) -> None:
    A, y = problems.draw(1, 600, k=2)
    found = least_squares(rows(A, y), problems.names, method="ols")
    np.testing.assert_allclose(found.x, np.linalg.lstsq(A.reshape(-1, 3), y.ravel(), rcond=None)[0], rtol=1e-12)
    residuals = y - A @ found.x
    assert found.scale == pytest.approx(np.sqrt(np.sum(residuals**2) / (residuals.size - 3)))
    unsure = student_factor(np.array([3.0]), np.array([residuals.size - 3.0]))
    whole = unsure * found.scale**2 * np.linalg.inv(np.einsum("nki,nkj->ij", A, A))
    np.testing.assert_allclose(found.cov, whole, rtol=1e-9)
    np.testing.assert_allclose(found.R @ found.basis @ (found.R @ found.basis).T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(least_squares(rows(A, A @ problems.theta), problems.names).x, problems.theta, rtol=1e-11)
    A[:, 1] = 0.0  # a class without signal
    np.testing.assert_allclose(least_squares(rows(A, A @ problems.theta), problems.names).x, problems.theta, rtol=1e-11)


def test_ten_digits_at_a_scaled_condition_of_1e4() -> None:
    """Normal equations would keep eight of sixteen digits at best; the target is eight."""
    rng = np.random.default_rng(0)
    left, right = np.linalg.qr(rng.standard_normal((3000, 20)))[0], np.linalg.qr(rng.standard_normal((20, 20)))[0]
    A = (left * np.geomspace(1.0, 1e-4, 20)) @ right * np.geomspace(1e-6, 1e6, 20)
    truth = rng.standard_normal(20) / np.geomspace(1e-6, 1e6, 20)
    found = least_squares(
        [Rows(A, A @ truth, np.arange(3000) // 100)], [f"p{i}" for i in range(20)], method="ols", max_condition=1e6
    )
    assert found.excitation.condition > 3e3
    np.testing.assert_allclose(found.x, truth, rtol=1e-10)


def test_wls_weighs_each_class_by_its_own_noise(problems) -> None:
    errors = {method: [] for method in ("ols", "wls")}
    for seed in range(25):
        A, y = problems.draw(seed, 300, k=2)
        y = A @ problems.theta + (y - A @ problems.theta) * [1.0, 100.0]
        for method, found in errors.items():
            s = least_squares(rows(A, y), problems.names, method=method)
            found.append((s.x - problems.theta)[0])
            if method == "wls":
                np.testing.assert_allclose(s.sigma, [1.0, 100.0], rtol=0.2)
                np.testing.assert_allclose(s.weights, 1.0 / s.sigma, rtol=1e-5)
                assert s.scale == pytest.approx(1.0, abs=1e-5)
    assert np.std(errors["wls"]) < 0.1 * np.std(errors["ols"])


@pytest.mark.parametrize("method", METHODS)
def test_formal_covariance_is_honest_for_white_noise(method: str, problems) -> None:
    nees = []
    for seed in range(30):
        A, y = problems.draw(seed, 400)
        found = least_squares(rows(A, y), problems.names, method=method)
        error = found.x - problems.theta
        nees.append(error @ np.linalg.solve(found.cov, error) / 3)
    assert np.mean(nees) == pytest.approx(1.0, abs=0.35)  # standard error 0.15; trimming sometimes drops a good block


@pytest.mark.parametrize(("method", "stays"), [("ols", False), ("irls", True), ("lts", True)])
def test_gross_outliers(method: str, stays: bool, problems) -> None:
    """5 % of the rows off by ten standard deviations: at most 1.3 times the clean error, except for OLS."""
    clean, spoilt = [], []
    for seed in range(20):
        A, y = problems.draw(seed, 3000)
        clean.append(least_squares(rows(A, y), problems.names, method="ols").x - problems.theta)
        bad = np.zeros(3000, dtype=bool)
        rng = np.random.default_rng(seed)
        if method == "lts":  # meant for whole segments, such as a push
            bad[1000:1150] = True
            y = y + 10.0 * bad[:, None]
        else:
            bad[rng.choice(3000, 150, replace=False)] = True
            y = y + 10.0 * rng.choice([-1, 1], y.shape) * bad[:, None]
        found = least_squares(rows(A, y), problems.names, method=method)
        spoilt.append(found.x - problems.theta)
        if method == "irls":
            assert found.converged
            assert np.mean(found.row_weights[bad]) < 0.3 < 0.9 < np.mean(found.row_weights[~bad])
        if method == "lts":
            assert not found.kept[10]
            assert found.kept.sum() >= 25
    ratio = np.sqrt(np.mean(np.square(spoilt), axis=0) / np.mean(np.square(clean), axis=0))
    assert (ratio[0] < 1.3) == stays
    if not stays:
        assert ratio[0] > 2.0


def test_trimming_needs_blocks_that_determine_the_model_together(problems) -> None:
    A, y = problems.draw(3, 600)
    A[60:, 0, 2] *= 1e-5  # one block in ten determines the third parameter
    rows = list(Rows.of(A, y, np.arange(600) // 60))
    with pytest.raises(NotExcited, match="Move every joint throughout the recording"):
        least_trimmed_squares(least_squares(rows, problems.names))


def test_bounds_hold_and_say_what_they_cost(problems) -> None:
    A, y = problems.draw(3, 400)
    free = least_squares(rows(A, y), problems.names)
    lower = np.array([1.5, -np.inf, 0.0])
    found = least_squares(rows(A, y), problems.names, lower=lower)
    assert found.x[0] == 1.5
    assert [a.name for a in found.active] == ["mass"]
    assert found.active[0].free == pytest.approx(free.x[0], rel=1e-3)
    assert "mass held at its bound 1.5; without the bound" in found.active[0].text()
    rms = [np.sqrt(np.mean((y - A @ s.x) ** 2)) for s in (free, found)]
    assert found.growth == pytest.approx(rms[1] / rms[0] - 1.0, rel=1e-6)
    assert free.active == ()
    assert free.growth == 0.0
    assert found.cov[0, 0] > 0  # a bound is not a measurement
    np.testing.assert_array_equal(least_squares(rows(A, y), problems.names, lower=np.full(3, -1e4)).x, free.x)


def test_what_the_data_do_not_tell_is_refused_by_name_or_held_by_a_prior(problems) -> None:
    A, y = problems.draw(4, 400)
    A = np.concatenate([A, A[:, :, :1] * 2.0], axis=2)  # only its sum with mass is identifiable
    names = (*problems.names, "load")
    with pytest.raises(NotExcited, match=r"mass and load|load and mass"):
        least_squares(rows(A, y), names)
    prior = Prior(np.array([0.5, 0.0, 0.0, 0.2]), np.array([0.3, 1.0, 1.0, 0.1]))
    found = least_squares(rows(A, y), names, prior=prior)
    assert len(found.excitation.held) == 1
    assert "held by the prior: " in found.excitation.text()
    assert found.basis.shape == (4, 3)
    np.testing.assert_allclose(found.x[0] + 2 * found.x[3], 1.0, atol=0.2)  # determined by the data
    hidden = found.excitation.vectors[:, 3] * found.excitation.scale
    np.testing.assert_allclose(hidden @ found.x, hidden @ prior.values, rtol=1e-9)
    np.testing.assert_allclose(hidden @ found.cov @ hidden, np.sum((hidden * prior.sd) ** 2), rtol=1e-6)
    bounded = least_squares(rows(A, y), names, prior=prior, lower=np.array([-np.inf, -np.inf, -np.inf, 0.3]))
    assert bounded.x[3] == 0.3
    np.testing.assert_allclose(bounded.x[0] + 2 * bounded.x[3], found.x[0] + 2 * found.x[3], rtol=0.05)


def test_within_bounds_of_parameters_that_vary_as_one() -> None:
    """A draft from few logs gives such covariances, singular while both parameters are at their bounds."""
    cov, bound = np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), np.ones(3)
    found = within_bounds(np.array([2.0, 3.0, 0.5]), cov, -bound, bound)
    np.testing.assert_allclose(found, [0.0, 1.0, 0.5], atol=1e-9)


@pytest.mark.parametrize("seed", range(24))
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


RNG = np.random.default_rng(0)
A = RNG.standard_normal((90, 2, 4))
A[:, 0, 3] = 0.0  # class 0 has no fourth column
Y = RNG.standard_normal((90, 2))
BLOCK = np.arange(90) // 30


@given(cuts=st.lists(st.integers(1, 89), max_size=6, unique=True), order=st.randoms())
@settings(max_examples=25)
def test_pieces_and_their_order_change_nothing_but_rounding(cuts: list[int], order) -> None:
    def part(a: int, b: int, g: int) -> Rows:
        columns = np.arange(3 + g)
        return Rows(A[a:b, g][:, columns], Y[a:b, g], BLOCK[a:b], g, columns)

    pieces = [part(a, b, g) for a, b in pairwise([0, *sorted(cuts), 90]) for g in range(2)]
    order.shuffle(pieces)
    x = np.array([0.3, 0.1, -1.0, 2.0])
    whole = factorise(Rows.of(A, Y, BLOCK), 4)
    np.testing.assert_allclose(factorise(iter(pieces), 4).power(x), whole.power(x), rtol=1e-12)


def threads() -> dict[str, int]:
    """Threads of each BLAS that is loaded; one that was built for a single thread always has one."""
    return {pool["filepath"]: pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


def test_the_last_of_two_that_overlap_gives_the_threads_back() -> None:
    with threadpool_limits(2, "blas"):
        before = threads()
        assert 2 in before.values()
        first, second = one_thread(), one_thread()
        first.__enter__()
        second.__enter__()
        first.__exit__(None, None, None)
        assert set(threads().values()) == {1}
        second.__exit__(None, None, None)
        assert threads() == before
