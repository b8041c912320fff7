"""Distributions over motions: marginals and samples, conditioning as a Kalman update, blending, files, refusals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab.errors import ConfigError, ShapeError
from armlab.motion import ProMP, TrajectoryDistribution

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


def test_bad_input_is_refused_by_a_sentence(promp: ProMP) -> None:
    stiff = replace(promp, cov=np.zeros_like(promp.cov))
    for words, call in {
        "neither": lambda: promp.condition(1.0),
        "got nan s": lambda: promp.condition(np.nan, [0.0, 0.0]),
        "got -1 s": lambda: promp.condition(-1.0, [0.0, 0.0]),
        "from 0 to 0.5 s": lambda: promp.condition(1.0, [0.0, 0.0], duration=0.5),
        "y of shape": lambda: promp.condition(1.0, [0.0]),
        "finite y": lambda: promp.condition(1.0, [0.0, np.nan]),
        "different coordinates": lambda: promp.condition(1.0, [0.0], coordinates=[2]),
        "covariance as a number": lambda: promp.condition(1.0, [0.0, 0.0], cov=np.eye(3)),
        "not negative": lambda: promp.condition(1.0, [0.0, 0.0], cov=-1.0),
        "do not differ": lambda: stiff.condition(1.0, [9.0, 9.0]),
        "duration": lambda: promp.marginal(T, duration=0.0),
        "times": lambda: promp.marginal([0.0, np.nan]),
        "seed": lambda: promp.sample(T, -1, 2),
        "mean weights": lambda: replace(promp, mean=np.zeros(3)),
        "cov of shape": lambda: replace(promp, cov=np.eye(3)),
        "symmetric cov": lambda: replace(promp, cov=np.triu(np.ones((16, 16)))),
        "widths above zero": lambda: replace(promp, widths=0 * promp.widths),
        "finite mean": lambda: replace(promp, mean=np.full((M, 2), np.nan)),
    }.items():
        with pytest.raises(ShapeError, match=words):
            call()
    with pytest.raises(ConfigError, match="count"):
        promp.sample(T, 0, 0)
