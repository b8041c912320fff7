"""Distributions over motions: marginals, conditioning, blends, and fits with their statistical contract."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab.estimation import Experiment, Fit, Gauge, check_estimator
from armlab.motion import ProMP, TrajectoryDistribution, blend, fit_promp
from armlab.motion.primitive.equation import normalised

M, N_JOINTS = 8, 2
T = np.linspace(0.0, 2.0, 21)


@pytest.fixture(scope="module")
def promp() -> ProMP:
    rng = np.random.default_rng(0)
    root = rng.normal(size=(M * N_JOINTS, M * N_JOINTS))
    centres = np.linspace(0, 1, M)
    return ProMP(
        rng.normal(size=(M, N_JOINTS)), 0.1 * root @ root.T, centres, np.full(M, 0.12), 2.0, np.array([0.1, 0.2])
    )


def test_marginals_are_those_of_many_samples(promp: ProMP) -> None:
    band, drawn = promp.marginal(T), promp.sample(T, 1, 4000)
    assert isinstance(band, TrajectoryDistribution)
    assert drawn.shape == (4000, 21, 2)
    np.testing.assert_allclose(drawn.mean(axis=0), band.y, atol=0.1)
    sample_cov = np.einsum("kti,ktj->tij", drawn - band.y, drawn - band.y) / 4000
    np.testing.assert_allclose(sample_cov, band.cov, atol=0.12 * band.cov.max())
    np.testing.assert_allclose(band.sd**2, np.diagonal(band.cov, axis1=1, axis2=2), atol=1e-12)
    np.testing.assert_array_equal(promp.sample(T, 7, 2), promp.sample(T, np.random.default_rng(7), 2))
    for values in (band.y, band.cov, promp.mean):
        with pytest.raises(ValueError, match="read-only"):
            values[0] = 0


def test_velocity_is_the_derivative(promp: ProMP) -> None:
    h = 1e-6
    before, now, after = (promp.marginal(T + s) for s in (-h, 0, h))
    np.testing.assert_allclose((after.y - before.y) / (2 * h), now.yd, atol=1e-6)
    psi, rate = promp.kernels(T)
    blocks = promp.cov.reshape(2, M, 2, M)
    np.testing.assert_allclose(now.velocity_cov, np.einsum("ta,iajb,tb->tij", rate, blocks, rate), atol=1e-9)
    np.testing.assert_allclose(psi.sum(axis=1), 1.0, atol=1e-14)


def test_time_stretches(promp: ProMP) -> None:
    once, twice = promp.marginal(T), promp.marginal(2 * T, duration=4.0)
    np.testing.assert_allclose(twice.y, once.y, atol=1e-12)
    np.testing.assert_allclose(2 * twice.yd, once.yd, atol=1e-12)
    assert len(promp.marginal(0.1).t) == 21


def test_conditioning_passes_the_point_with_its_covariance(promp: ProMP) -> None:
    near = promp.condition(1.0, [0.5, -0.7], yd=[0.0, 1.0])
    at = near.marginal([1.0])
    np.testing.assert_allclose(at.y[0], [0.5, -0.7], atol=1e-9)
    np.testing.assert_allclose(at.yd[0], [0.0, 1.0], atol=1e-8)
    np.testing.assert_allclose([at.cov[0], at.velocity_cov[0]], 0.0, atol=1e-7)
    one = promp.condition(0.4, [0.3], coordinates=[1], cov=0.04).marginal([0.4])
    prior = promp.marginal([0.4])
    gain = prior.cov[0, 1, 1] / (prior.cov[0, 1, 1] + 0.04)
    np.testing.assert_allclose(one.y[0, 1], prior.y[0, 1] + gain * (0.3 - prior.y[0, 1]), rtol=1e-9)
    np.testing.assert_allclose(one.cov[0, 1, 1], (1 - gain) * prior.cov[0, 1, 1], rtol=1e-9)


def test_conditioning_twice_in_any_order_is_the_same(promp: ProMP) -> None:
    a = promp.condition(0.5, [0, 0], cov=0.01).condition(1.5, [1, 1], cov=0.02)
    b = promp.condition(1.5, [1, 1], cov=0.02).condition(0.5, [0, 0], cov=0.01)
    np.testing.assert_allclose(a.mean, b.mean, atol=1e-9)
    np.testing.assert_allclose(a.cov, b.cov, atol=1e-9)


def test_blending_goes_from_one_motion_to_the_other(promp: ProMP) -> None:
    other = replace(promp, mean=promp.mean + 1.0)
    share = np.linspace(0, 1, 21)[:, None]
    band = blend([promp, other], np.hstack([1 - share, share]), T)
    np.testing.assert_allclose(band.y[0], promp.marginal(T).y[0], atol=1e-6)
    np.testing.assert_allclose(band.y[-1], other.marginal(T).y[-1], atol=1e-6)
    both = blend([promp, other], [1.0, 1.0], T)
    np.testing.assert_allclose(both.y, promp.marginal(T).y + 0.5, atol=1e-6)
    np.testing.assert_allclose(both.cov, 0.5 * promp.marginal(T).cov, rtol=1e-3, atol=1e-6)


M_BASIS, NOISE, TIMES = 4, 0.02, np.linspace(0.0, 2.0, 12)
MEAN = np.array([0.1, 0.8, -0.3, 0.5])
SPREAD = np.diag([0.02, 0.1, 0.05, 0.03]) + 0.02
PSI = normalised(TIMES[:, None] / 2.0, np.linspace(0, 1, M_BASIS), np.full(M_BASIS, 0.8 / (M_BASIS - 1)))[0]


def experiment(seed: int, n: int) -> Experiment:
    """n demonstrations of one coordinate."""
    rng = np.random.default_rng([3, seed])
    w = rng.multivariate_normal(MEAN, SPREAD, n)
    y = (w @ PSI.T + NOISE * rng.standard_normal((n, len(TIMES))))[..., None]
    bound = (SPREAD + NOISE**2 * np.linalg.inv(PSI.T @ PSI)) / n
    return Experiment({"t": TIMES, "y": y}, MEAN, bound)


def fit(t: np.ndarray, y: np.ndarray) -> Fit[ProMP]:
    return fit_promp(t, y, n_basis=M_BASIS)


def test_the_statistical_contract() -> None:
    contract = check_estimator(
        fit,
        experiment,
        runs=25,
        n=60,
        noise_given=False,
        refusals={"weight 3": {"t": TIMES[:3], "y": np.zeros((5, 3, 1))}},
        gauges=[Gauge("milliradian", lambda data: {**data, "y": 1e3 * data["y"]}, lambda fit: 1e3 * fit.parameters)],
        skip={"robust": "a demonstration that differs is what the distribution is of"},
    )
    assert contract.passed, contract.text()


def test_mean_covariance_and_noise_of_a_known_truth_are_found() -> None:
    case = experiment(0, 2000)
    found = fit(**case.data)
    value = found.value
    np.testing.assert_allclose(value.mean[:, 0], MEAN, atol=0.02)
    np.testing.assert_allclose(value.cov, SPREAD, atol=0.012)
    np.testing.assert_allclose(value.noise, NOISE, rtol=0.03)
    assert value.duration == 2.0
    assert found.n == 2000


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
    for _ in range(150):
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
    order = rng.permutation(150)
    again = fit_promp([t[k] for k in order], [y[k] for k in order], n_basis=M_BASIS)
    np.testing.assert_allclose(again.parameters, found.parameters, rtol=0, atol=1e-12)


def test_two_demonstrations_are_enough() -> None:
    y = np.stack([np.sin(TIMES), 1.2 * np.sin(TIMES)])[..., None]
    found = fit_promp(TIMES, y, n_basis=6)
    assert found.rank == 1
    band = found.value.marginal(TIMES)
    np.testing.assert_allclose(band.y[:, 0], 1.1 * np.sin(TIMES), atol=2e-2)
