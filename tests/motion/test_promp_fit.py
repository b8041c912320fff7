"""Fits of distributions over motions: the statistical contract, what is found of a known truth, what is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from armlab.errors import ConfigError, NotExcited, ShapeError
from armlab.estimation import Experiment, Fit, Gauge, check_estimator
from armlab.motion import ProMP, fit_promp
from armlab.motion.dmp.equation import normalised

M_BASIS, NOISE, T = 4, 0.02, np.linspace(0.0, 2.0, 12)
MEAN = np.array([0.1, 0.8, -0.3, 0.5])
SPREAD = np.diag([0.02, 0.1, 0.05, 0.03]) + 0.02
PSI = normalised(T[:, None] / 2.0, np.linspace(0, 1, M_BASIS), np.full(M_BASIS, 0.8 / (M_BASIS - 1)))[0]


def experiment(seed: int, n: int) -> Experiment:
    """n demonstrations of one coordinate."""
    rng = np.random.default_rng([3, seed])
    w = rng.multivariate_normal(MEAN, SPREAD, n)
    y = (w @ PSI.T + NOISE * rng.standard_normal((n, len(T))))[..., None]
    bound = (SPREAD + NOISE**2 * np.linalg.inv(PSI.T @ PSI)) / n
    return Experiment({"t": T, "y": y}, MEAN, bound)


def fit(t: np.ndarray, y: np.ndarray) -> Fit[ProMP]:
    return fit_promp(t, y, n_basis=M_BASIS)


def test_the_statistical_contract() -> None:
    contract = check_estimator(
        fit,
        experiment,
        runs=40,
        n=60,
        noise_given=False,
        refusals={"weight 3": {"t": T[:3], "y": np.zeros((5, 3, 1))}},
        gauges=[Gauge("milliradian", lambda data: {**data, "y": 1e3 * data["y"]}, lambda fit: 1e3 * fit.parameters)],
        skip={"robust": "a demonstration that differs is what the distribution is of"},
    )
    assert contract.passed, contract.text()


def test_mean_covariance_and_noise_of_a_known_truth_are_found() -> None:
    case = experiment(0, 4000)
    found = fit(**case.data)
    value = found.value
    np.testing.assert_allclose(value.mean[:, 0], MEAN, atol=0.02)
    np.testing.assert_allclose(value.cov, SPREAD, atol=0.012)
    np.testing.assert_allclose(value.noise, NOISE, rtol=0.03)
    assert value.duration == 2.0
    assert found.n == 4000


def test_covariance_is_without_the_noise_and_demonstrations_are_weighed_by_theirs() -> None:
    """``cov = S - mean sigma^2 G_i`` and the mean by ``(cov + sigma^2 G_i)^-1``, of 6 to 40 samples each."""
    rng = np.random.default_rng(7)
    ts = [np.linspace(0.0, 2.0, N) for N in (6, 8, 40, 7, 30, 6, 12, 25)]
    designs = [normalised(t[:, None] / 2.0, np.linspace(0, 1, 4), np.full(4, 0.8 / 3))[0] for t in ts]
    w = [rng.multivariate_normal(MEAN, SPREAD) for _ in ts]
    ys = [A @ one + 0.05 * rng.standard_normal(len(A)) for A, one in zip(designs, w)]
    found = fit_promp(ts, ys, n_basis=4)
    w, squares, _, _ = zip(*(np.linalg.lstsq(A, y) for A, y in zip(designs, ys)))
    noise = np.sqrt(np.sum(squares) / sum(len(t) - 4 for t in ts))
    np.testing.assert_allclose(found.value.noise, noise, rtol=1e-9)
    own = [noise**2 * np.linalg.inv(A.T @ A) for A in designs]
    values, vectors = np.linalg.eigh(np.cov(np.transpose(w)) - np.mean(own, axis=0))
    assert values[0] < 0.0 < values[-2]
    cov = (vectors * values.clip(min=0.0)) @ vectors.T
    np.testing.assert_allclose(found.value.cov, cov, rtol=0, atol=1e-12)
    parts = [np.linalg.inv(cov + G) for G in own]
    total = np.linalg.inv(np.sum(parts, axis=0))
    mean = total @ sum(part @ one for part, one in zip(parts, w))
    np.testing.assert_allclose(found.parameters, mean, rtol=0, atol=1e-10)
    np.testing.assert_allclose(found.cov, total, rtol=0, atol=1e-12)
    assert np.abs(mean - np.mean(w, axis=0)).max() > 0.01


def test_demonstrations_of_other_lengths_and_clocks() -> None:
    rng = np.random.default_rng(5)
    t, y = [], []
    for _ in range(300):
        own = np.sort(np.r_[0.0, rng.uniform(0, 1, rng.integers(20, 40)), 1.0])
        psi = normalised(own[:, None], np.linspace(0, 1, M_BASIS), np.full(M_BASIS, 0.8 / (M_BASIS - 1)))[0]
        t.append(7.0 + own * rng.uniform(1, 3))
        w = rng.multivariate_normal(MEAN, SPREAD, 2).T
        y.append(psi @ w + NOISE * rng.standard_normal((len(own), 2)))
    found = fit_promp(t, y, n_basis=M_BASIS)
    e = found.parameters - np.r_[MEAN, MEAN]
    assert 2.0 < e @ np.linalg.solve(found.cov, e) < 25.0  # 8 degrees of freedom
    np.testing.assert_allclose(found.value.cov[:4, :4], SPREAD, atol=0.04)
    np.testing.assert_allclose(found.value.cov[:4, 4:], 0.0, atol=0.04)
    order = rng.permutation(300)
    again = fit_promp([t[k] for k in order], [y[k] for k in order], n_basis=M_BASIS)
    np.testing.assert_allclose(again.parameters, found.parameters, rtol=0, atol=1e-12)


def test_two_demonstrations_are_enough() -> None:
    y = np.stack([np.sin(T), 1.2 * np.sin(T)])[..., None]
    found = fit_promp(T, y, n_basis=6)
    assert found.rank == 1
    band = found.value.marginal(T)
    np.testing.assert_allclose(band.y[:, 0], 1.1 * np.sin(T), atol=2e-2)


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"y": np.zeros((1, 12, 1))}, ShapeError, "2 demonstrations or more"),
        ({"t": [T], "y": [np.zeros((12, 1))]}, ShapeError, "2 demonstrations or more"),
        ({"y": np.full((3, 12, 1), np.nan)}, ShapeError, "of demonstration 0"),
        ({"t": [], "y": []}, ShapeError, "2 demonstrations or more"),
        ({"t": T[:5]}, ShapeError, "shapes"),
        ({"t": np.zeros(12)}, ShapeError, "times that increase"),
        ({"n_basis": 2}, ConfigError, "3 to 1000"),
        ({"n_basis": 13}, NotExcited, "at least 13 samples"),
        ({"t": [T, T], "y": [np.zeros((12, 1)), np.zeros((12, 2))]}, ShapeError, "as many coordinates"),
    ],
)
def test_bad_input_is_refused_by_a_sentence(change: dict[str, Any], error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        fit_promp(**{"t": T, "y": np.zeros((3, 12, 1)), "n_basis": 4, **change})
