"""Fits of movement primitives as estimators: the contract, noise of ends, primitives drawn from demonstrations."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from armlab.estimation import Experiment, Gauge, check_estimator
from armlab.motion import fit_dmp

U = np.linspace(0, 1, 1001)
S = 10 * U**3 - 15 * U**4 + 6 * U**5


def test_samples_have_the_mean_and_covariance_of_the_demonstrations() -> None:
    rng = np.random.default_rng(2)
    ys = [(S + a * np.sin(np.pi * U) ** 2)[::10, None] for a in rng.normal(size=6) * 0.2]
    dmp = fit_dmp([U[::10]] * 6, ys, n_basis=5).value
    drawn = np.array([dmp.sample(rng).weights.ravel() for _ in range(2000)])
    root = np.sqrt(np.diag(dmp.weight_covariance))
    assert (abs(drawn.mean(axis=0) - dmp.mean_weights.ravel()) < 4 * root / np.sqrt(2000) + 1e-9).all()
    np.testing.assert_allclose(np.cov(drawn.T), dmp.weight_covariance, atol=0.15 * root.max() ** 2)
    assert dmp.demo_weights is not None
    np.testing.assert_allclose(np.cov(dmp.demo_weights[..., 0].T), dmp.weight_covariance, atol=1e-9 * root.max() ** 2)


def drawn(seed: int, n: int, unit: float = 1.0, **options: Any) -> Experiment:
    """Noisy samples of a primitive of known weights."""
    t = np.linspace(0, 1, n)
    shape = np.stack([1 + S, 2 - S + 20 * (U - U**2) ** 3], axis=1)  # from rest to rest
    truth = fit_dmp(U, shape, n_basis=8, pin=("y0", "v0", "g"), hold=2.0).value
    y = unit * (truth.rollout(t).y + np.random.default_rng(seed).normal(size=(n, 2)) * 1e-2)
    ends = {"y0": unit * truth.y0, "g": unit * truth.g}
    parts = np.concatenate([truth.weights, [truth.y0, truth.v0, truth.g]]) * unit
    return Experiment({"t": t, "y": y, "n_basis": 8, "hold": 0.0, **ends, **options}, parts.T.ravel())


def test_the_fit_meets_the_contract() -> None:
    def scaled(data: dict[str, Any]) -> dict[str, Any]:
        return {k: 1000 * np.asarray(a) if k in ("y", "y0", "g") else a for k, a in data.items()}

    contract = check_estimator(
        fit_dmp,
        drawn,
        60,
        n=80,
        gauges=[Gauge("millimetres", scaled, lambda fit: 1000 * fit.parameters)],
        noise_given=False,
        skip={
            "efficient": "judged from 1000 runs on",
            "order-free": "samples are a motion in time",
            "refuses": "directions that the samples do not tell are left at zero and counted in the rank",
            "robust": "a motion has no outliers that could be told from it; give sample_weights",
        },
    )
    assert contract.passed, contract.text()


def test_noise_of_pinned_ends_is_in_the_covariance() -> None:
    def pinned(seed: int, n: int) -> Experiment:
        one = drawn(seed, n)
        return Experiment({k: a for k, a in one.data.items() if k not in ("y0", "g")}, one.truth)

    reasons = dict.fromkeys(
        ("consistent", "efficient", "order-free", "gauge-free", "refuses", "robust", "saves", "explains", "clean"),
        "the ends are one sample each however many there are",
    )
    contract = check_estimator(fit_dmp, pinned, 60, n=80, noise_given=False, skip=reasons)
    assert contract.passed, contract.text()


@pytest.mark.parametrize(
    "options",
    [{}, {"hold": 0.0}, {"hold": 0.0, "pin": ()}, {"pin": ("y0", "v0", "g")}, {"y0": np.zeros(40), "g": np.zeros(40)}],
    ids=["default", "no hold", "free", "pinned", "known"],
)
def test_degrees_of_freedom_are_the_trace_of_what_residuals_are_of_the_samples(options: dict[str, Any]) -> None:
    """A fit to the unit samples has that matrix as its residuals; ``sigma^2 = sum r^2 / trace``."""
    t = np.linspace(0.0, 1.0, 40)
    fit = fit_dmp(t, np.eye(40), n_basis=6, scaling="none", **options)
    trace = abs(np.trace(fit.residuals))
    np.testing.assert_allclose(fit.sigma, np.sqrt((fit.residuals**2).sum(axis=0) / trace), rtol=1e-9)
    if options.get("hold") == 0.0 and options.get("pin") == ():
        np.testing.assert_allclose(trace, 40 - 6 - 3, rtol=1e-9)


def test_noise_of_a_position_phase_is_that_of_its_residuals() -> None:
    t = np.linspace(0.0, 1.0, 101)
    y = S[::10, None] + 1e-4 * np.random.default_rng(0).normal(size=(101, 1))
    fit = fit_dmp(t, np.maximum.accumulate(y), schedule="position", n_basis=10)
    np.testing.assert_allclose(fit.sigma, np.sqrt((fit.residuals**2).sum(axis=0) / (101 - 10)), rtol=1e-9)


def test_the_start_velocity_is_the_nearest_to_those_of_the_demonstrations() -> None:
    """``v0 s T0 / T`` is that of a demonstration s times as far in T seconds; the least squares of the three."""
    durations, ends, slopes = np.array([1.0, 2.0, 4.0]), np.array([1.0, 2.0, 6.0]), np.array([0.5, -0.2, 0.9])
    ts = [T * U[::10] for T in durations]
    ys = [end * S[::10] + slope * t * (1 - t / t[-1]) ** 2 for t, end, slope in zip(ts, ends, slopes)]
    found = fit_dmp(ts, ys, n_basis=6, pin=("y0", "v0", "g")).value
    v = np.array([(y[1] - y[0]) / t[1] for t, y in zip(ts, ys)])
    s = ends / ends.mean()
    wanted = np.linalg.lstsq(s[:, None], v * durations / durations.mean())[0]
    np.testing.assert_allclose(found.v0, wanted, rtol=1e-9)
