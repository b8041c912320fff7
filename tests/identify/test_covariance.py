"""Torque covariance over velocity: recovered from synthetic residuals, within its own formal deviation."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import NotExcited, ShapeError, UnknownName
from armlab.estimation import Experiment, check_estimator
from armlab.identify import fit_velocity_covariance
from armlab.models import velocity_covariance

C0, CINF, RATE = 0.25, 0.01, 30.0


def sample(seed: int, kind: str, N: int = 6000) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    qd = 0.3 * rng.standard_normal((N, 2))
    shape = [RATE, RATE] if kind == "exp" else [0.05, 0.05]
    truth = velocity_covariance(kind, [C0, 4 * C0], [CINF, 4 * CINF], shape)
    return rng.standard_normal((N, 2)) * np.sqrt(truth.variance(qd)), qd


@pytest.mark.parametrize("kind", ["exp", "step"])
def test_fit_velocity_covariance_recovers_the_truth(kind: str) -> None:
    fit = fit_velocity_covariance(*sample(0, kind, 40_000), kind=kind)
    np.testing.assert_allclose(fit.value.C0, [C0, 4 * C0], rtol=0.1)
    np.testing.assert_allclose(fit.value.Cinf, [CINF, 4 * CINF], rtol=0.05)
    np.testing.assert_allclose(fit.value.shape, RATE if kind == "exp" else 0.05, rtol=0.1)


def test_errors_match_the_formal_deviation() -> None:
    """Normalised squared errors of log C0, log Cinf and log rate over 60 seeds average to one per parameter."""
    expected = np.array([np.log(CINF), np.log(C0 / CINF), np.log(RATE)])
    nees = []
    for seed in range(60):
        fit = fit_velocity_covariance(*sample(seed, "exp"))
        error = fit.parameters[:3] - expected
        nees.append(error @ np.linalg.solve(fit.cov[:3, :3], error) / 3)
    assert 0.7 < np.mean(nees) < 1.35


@pytest.mark.parametrize("kind", [pytest.param("exp", marks=pytest.mark.slow), "step"])  # 6 s, 1 s
def test_the_statistical_contract(kind: str) -> None:
    def experiment(seed: int, n: int) -> Experiment:
        residuals, qd = sample(seed, kind, n)
        shape = RATE if kind == "exp" else 0.05
        truth = [np.log([CINF * k, C0 / CINF, shape]) for k in (1, 4)]
        return Experiment({"residuals": residuals, "qd": qd}, np.concatenate(truth))

    contract = check_estimator(
        lambda residuals, qd: fit_velocity_covariance(residuals, qd, kind),
        experiment,
        60,
        n=3000,
        refusals={"everything": {"residuals": np.ones((50, 2)), "qd": np.ones((50, 2))}},
        skip={
            "gauge-free": "another unit of torque or speed has a test of its own",
            "robust": "a variance is what it is with the outliers that there are",
            "efficient": "needs 1000 runs",
        },
    )
    assert contract.passed, contract.text()


@pytest.mark.parametrize("kind", ["exp", "step"])
def test_another_unit_of_torque_changes_the_variances_alone(kind: str) -> None:
    residuals, qd = sample(0, kind)
    one, other = fit_velocity_covariance(residuals, qd, kind), fit_velocity_covariance(1000.0 * residuals, qd, kind)
    expected = one.parameters + np.tile([np.log(1e6), 0.0, 0.0], 2)
    np.testing.assert_allclose(other.parameters, expected, rtol=1e-5)
    np.testing.assert_allclose(other.cov, one.cov, rtol=1e-3, atol=1e-9)


def test_a_slow_motion_is_no_memory_of_the_noise() -> None:
    """White noise along a slow sway tells as much as along speeds that are drawn; noise that remembers tells less."""
    rng = np.random.default_rng(0)
    qd = 0.3 * np.sin(2 * np.pi * np.arange(6000) / 1500.0)[:, None]
    truth = velocity_covariance("exp", [C0], [CINF], [RATE])
    noise = rng.standard_normal((6000, 1)) * np.sqrt(truth.variance(qd))
    drawn = rng.permutation(6000)
    sd = fit_velocity_covariance(noise, qd).sd
    np.testing.assert_allclose(sd, fit_velocity_covariance(noise[drawn], qd[drawn]).sd, rtol=0.1)
    held = np.repeat(rng.standard_normal(600), 10)[:, None] * np.sqrt(truth.variance(qd))
    assert np.all(fit_velocity_covariance(held, qd).sd > 2.5 * sd)


def test_a_step_is_found_between_two_samples_of_speed() -> None:
    """The threshold has no grid: it lies within samples of where the variance jumps; without a jump it is not known."""
    rng = np.random.default_rng(3)
    qd = rng.permutation(np.linspace(0.001, 1.0, 1000))[:, None]
    noise = rng.standard_normal((1000, 1))
    found = fit_velocity_covariance(np.where(qd < 0.3005, 30.0, 1.0) * noise, qd, "step")
    assert found.value.shape[0] == pytest.approx(0.3005, abs=0.003)
    assert 0.8e-3 < found.sd[2] * 0.3005 < 1.5e-3
    assert fit_velocity_covariance(noise, qd, "step").sd[2] > 0.3


def test_what_the_data_do_not_tell_is_uncertain_and_never_exact() -> None:
    """White residuals have no rate of decay; always fast joints have no variance at rest."""
    rng = np.random.default_rng(0)
    e, qd = rng.standard_normal((2, 2000, 1))
    white = fit_velocity_covariance(e, qd)
    assert white.sd[2] > 0.5
    assert white.excitation.condition > 1.0
    fast = fit_velocity_covariance(e, 5 + 0.1 * qd)
    assert fast.sd[1] > 3.0
    assert np.all(fit_velocity_covariance(e, qd, "step").sd > 0.01)


def test_constant_is_the_mean_square() -> None:
    residuals, qd = sample(0, "exp")
    fit = fit_velocity_covariance(residuals, qd, "const")
    np.testing.assert_allclose(fit.value.variance(qd)[0], np.mean(residuals**2, axis=0))


def test_bad_input_is_refused() -> None:
    residuals, qd = sample(0, "exp")
    with pytest.raises(ShapeError, match="one shape"):
        fit_velocity_covariance(residuals, qd[:10])
    with pytest.raises(ShapeError, match=r"NaN or Inf in 1 rows, first \[3\]"):
        fit_velocity_covariance(residuals, np.where(qd == qd[3], np.nan, qd))
    with pytest.raises(ShapeError, match="one shape"):
        fit_velocity_covariance(residuals[:, :0], qd[:, :0])
    with pytest.raises(NotExcited, match="zeros for joint 2"):
        fit_velocity_covariance(residuals * [1.0, 0.0], qd)
    with pytest.raises(NotExcited, match="one speed"):
        fit_velocity_covariance(residuals, np.ones_like(qd), "step")
    with pytest.raises(NotExcited, match="at least 100"):
        fit_velocity_covariance(residuals[:10], qd[:10])
    with pytest.raises(UnknownName, match="const, exp, step"):
        fit_velocity_covariance(residuals, qd, "cubic")
