"""Linear least squares: plain, weighted, Huber and least trimmed squares."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import NotExcited
from armlab.estimation import Rows, huber, least_squares, least_trimmed_squares, mad
from armlab.estimation.robust import METHODS

BLOCKS = 30


def rows(A: np.ndarray, y: np.ndarray) -> list[Rows]:
    return list(Rows.of(A, y, np.arange(len(y)) * BLOCKS // len(y)))


def test_ols_is_that_of_lstsq(problems) -> None:
    A, y = problems.draw(1, 600, k=2)
    found = least_squares(rows(A, y), problems.names, method="ols")
    np.testing.assert_allclose(found.x, np.linalg.lstsq(A.reshape(-1, 3), y.ravel(), rcond=None)[0], rtol=1e-12)
    residuals = y - A @ found.x
    assert found.scale == pytest.approx(np.sqrt(np.sum(residuals**2) / (residuals.size - 3)))
    np.testing.assert_allclose(found.cov, found.scale**2 * np.linalg.inv(np.einsum("nki,nkj->ij", A, A)), rtol=1e-9)
    np.testing.assert_allclose(found.R @ found.basis @ (found.R @ found.basis).T, np.eye(3), atol=1e-12)


def test_ten_digits_at_a_scaled_condition_of_1e4() -> None:
    """Normal equations would leave eight of sixteen digits at best; the bar is eight."""
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
    """Noise of classes 1 and 100: WLS is as good as knowing it, OLS is far worse."""
    errors = {method: [] for method in ("ols", "wls")}
    for seed in range(40):
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
    for seed in range(60):
        A, y = problems.draw(seed, 400)
        found = least_squares(rows(A, y), problems.names, method=method)
        error = found.x - problems.theta
        nees.append(error @ np.linalg.solve(found.cov, error) / 3)
    assert np.mean(nees) == pytest.approx(1.0, abs=0.35)  # standard error 0.11; trimming sometimes drops a good block


@pytest.mark.parametrize(("method", "stays"), [("ols", False), ("irls", True), ("lts", True)])
def test_gross_outliers(method: str, stays: bool, problems) -> None:
    """5 % of the rows off by ten deviations: within 1.3 of the clean error, except for OLS."""
    clean, spoilt = [], []
    for seed in range(40):
        A, y = problems.draw(seed, 3000)
        clean.append(least_squares(rows(A, y), problems.names, method="ols").x - problems.theta)
        bad = np.zeros(3000, dtype=bool)
        rng = np.random.default_rng(seed)
        if method == "lts":  # it is for stretches of time: a push
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
    ratio = np.sqrt(np.mean(np.square(spoilt), axis=0) / np.mean(np.square(clean), axis=0))
    assert (ratio[0] < 1.3) == stays
    if not stays:
        assert ratio[0] > 2.0


def test_exact_data_and_silent_classes_do_no_harm(problems) -> None:
    A, _ = problems.draw(5, 200, k=2)
    found = least_squares(rows(A, A @ problems.theta), problems.names)
    np.testing.assert_allclose(found.x, problems.theta, rtol=1e-11)
    A[:, 1] = 0.0
    y = A @ problems.theta
    np.testing.assert_allclose(least_squares(rows(A, y), problems.names).x, problems.theta, rtol=1e-11)


# Robust least squares: its parts; the methods themselves are in test_linear.py.


def test_huber_is_a_stationary_point_of_its_loss(problems) -> None:
    A, y = problems.draw(1, 500)
    y[::20] += 30.0
    rows = list(Rows.of(A, y, np.arange(500) // 50))
    found = huber(rows, least_squares(rows, problems.names))
    scaled = (y - A @ found.x)[:, 0] / mad(y - A @ found.x)
    gradient = A[:, 0].T @ np.clip(scaled, -1.345, 1.345)
    assert np.max(np.abs(gradient) / np.linalg.norm(A[:, 0], axis=0)) < 1e-6
    assert found.rounds < 30


def test_trimmed_drops_a_third_of_a_contact_but_no_clean_blocks(problems) -> None:
    A, y = problems.draw(2, 3000)
    rows = list(Rows.of(A, y, np.arange(3000) // 100))
    clean = least_trimmed_squares(least_squares(rows, problems.names))
    assert clean.kept.sum() >= 28
    y[1000:1600] += 20.0  # a fifth of the record
    rows = list(Rows.of(A, y, np.arange(3000) // 100))
    found = least_trimmed_squares(least_squares(rows, problems.names))
    assert not found.kept[10:16].any()
    assert found.kept.sum() >= 22
    np.testing.assert_allclose(found.x, clean.x, atol=4 * clean.sd.max(), rtol=0.2)


def test_trimming_needs_blocks_that_determine_the_model_together(problems) -> None:
    A, y = problems.draw(3, 600)
    A[60:, 0, 2] *= 1e-5  # one block of ten tells the third parameter
    rows = list(Rows.of(A, y, np.arange(600) // 60))
    with pytest.raises(NotExcited, match="Let every joint move for the whole record"):
        least_trimmed_squares(least_squares(rows, problems.names))
