"""Residuals of a model along a record, its thermal state, and the noise models fitted to them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab.estimation import Experiment, check_estimator
from armlab.identify import fit_velocity_covariance, prepare
from armlab.identify.residuals import (
    BIN,
    Residuals,
    begun,
    dry_torques,
    friction_signs,
    mean_power,
    model_residuals,
    momentum_noise,
    relaxed,
    seconds,
    settled,
    stretches,
    velocity_noise,
)
from armlab.identify.validation import held_out
from armlab.kernels import presliding
from armlab.log import Table
from armlab.models import TorqueModel, velocity_covariance
from armlab.models.friction import WarmUp
from armlab.models.torque import FORCE_RATES, PRIOR


def test_residuals_are_measured_minus_modelled_torque(model: TorqueModel, excited: Table) -> None:
    found = model_residuals(excited, model)
    assert isinstance(found, Residuals)
    assert np.all(np.std(found.y, axis=0) < 0.3 * np.std(excited["tau"], axis=0))
    z = presliding(excited["q"], model.friction.delta, model.friction.resolution)
    assert np.array_equal(found.s, z)
    assert np.array_equal(friction_signs(model, found.data), z)
    smooth = replace(model, friction=replace(model.friction, smooth_speed=np.full(7, 0.05)))
    np.testing.assert_allclose(model_residuals(excited, smooth).s, np.tanh(excited["qd"] / 0.05))


# How warm drives are along a record: as the kernels have it.


def test_constant_power_warms_as_the_law_says() -> None:
    """x(t) = h + (x0 - h) exp(-t / T) in the middle of each second."""
    x = relaxed(np.full(600, 0.7), 150.0, 2.0)
    np.testing.assert_allclose(x, 0.7 + 1.3 * np.exp(-BIN * (np.arange(600) + 0.5) / 150.0), atol=2e-5)


def test_warmth_settles_with_its_own_friction() -> None:
    """Viscous friction f qd^2 (1 - 0.4 x) of constant speed: x = h / (1 + 0.4 h) in the end."""
    k = np.array([2.0, 0.0, 0.0, 0.0, -0.8, 0.0])
    power = np.tile([0.5, 0.0, 0.0], (3000, 1))
    assert settled(power, k, 120.0, 0.0, 1.0)[-1] == pytest.approx(1.0 / 1.4, rel=1e-3)


def test_pieces_begin_as_warm_as_the_log_has_made_them(truth, excited, model) -> None:
    """Torque of a piece alone is that of the whole log; without its warmth it is not."""
    zero = np.zeros(7)
    warm = WarmUp(zero - 0.3, zero - 0.4, np.where(np.arange(7) < 5, 20.0, 0.0), zero + 1.0, zero + 0.2)
    hot, data = replace(model, warm_up=warm), prepare(excited, truth.robot)
    whole = hot.torque(data.q, data.qd, dt=data.dt)
    pieces = [(0, 1000), (4000, 6000)]
    for one, a, b in begun(hot, data, pieces):
        alone = one.torque(data.q[a:b], data.qd[a:b], dt=data.dt[a:b])
        np.testing.assert_allclose(alone[500:], whole[a + 500 : b], atol=0.02)
    cold = hot.torque(data.q[4000:6000], data.qd[4000:6000], dt=data.dt[4000:6000])
    assert np.abs(cold[500:] - whole[4500:6000]).max() > 0.2
    assert [(one is model, a, b) for one, a, b in begun(model, data, pieces)] == [(True, 0, 1000), (True, 4000, 6000)]


def test_the_power_of_friction_is_its_torque_times_speed(truth, excited, model) -> None:
    data = prepare(excited, truth.robot)
    qd, s, number = data.qd[:, 2], friction_signs(model, data), seconds(data.t)
    c, rest = dry_torques(model, 2, qd, s[:, 2])
    zero = np.zeros(7)
    smooth = replace(model, ripple=replace(model.ripple, cosine=zero, sine=zero))
    friction = smooth.drive.torque(data.q, data.qd, s)[:, 2]
    np.testing.assert_allclose(
        model.friction.viscous[2] * qd + c + rest + model.friction.offset[2], friction, atol=1e-9
    )
    means = mean_power(model, 2, qd, s[:, 2], number)
    np.testing.assert_allclose(means[1, 1], np.mean((c * qd)[number == 1]), rtol=1e-12)


# Torque covariance over velocity: recovered from synthetic residuals, within its own formal deviation.


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


# What the momentum estimators need: memory, velocity noise, factors that make their 2 sigma hold.


def test_velocity_noise_is_found_under_the_motion(truth, excited) -> None:
    noise = velocity_noise(prepare(excited, truth.robot))
    np.testing.assert_allclose(noise, 1e-3, rtol=0.05)


def test_stretches_hold_the_rows_with_half_a_second_before(truth, excited) -> None:
    data = prepare(excited, truth.robot)
    rows = np.isin(np.arange(len(data.t)), [*range(50, 60), *range(2000, 2100), *range(2200, 2300)])
    assert list(stretches(rows, data)) == [(0, 60), (1876, 2300)]


def test_without_rows_that_count_nothing_is_scaled(truth, excited, model) -> None:
    data = prepare(excited, truth.robot)
    rows = np.ones(len(data.t), dtype=bool)
    noise = momentum_noise(model, [(model, rows)], np.full(data.q.shape, np.nan), data)
    assert (noise.alpha2_observer, noise.alpha2_kf) == (1.0, 1.0)
    np.testing.assert_allclose(noise.memory, 0.004)


def test_some_windows_of_a_long_record_tell_the_factors(truth, excited, model, monkeypatch) -> None:
    data = prepare(excited, truth.robot)
    rows = np.ones(len(data.t), dtype=bool)
    errors, moving = held_out([(model, rows)], data)
    errors = np.where(moving, errors, np.nan)
    whole = momentum_noise(model, [(model, rows)], errors, data)
    monkeypatch.setattr("armlab.identify.residuals.ENOUGH", len(rows) // 2)
    part = momentum_noise(model, [(model, rows)], errors, data)
    assert part.alpha2_observer != whole.alpha2_observer
    assert part.alpha2_observer == pytest.approx(whole.alpha2_observer, rel=0.2)
    np.testing.assert_array_equal(part.memory, whole.memory)


def test_momentum_noise_makes_two_sigma_hold(truth, excited, model) -> None:
    """On the rows that it is set on 95.4 % of the axes that can be seen, unless a factor met its bound."""
    data = prepare(excited, truth.robot)
    rows = np.arange(len(data.t)) < len(data.t) // 2
    folds = [(model, rows), (model, ~rows)]
    errors, moving = held_out(folds, data)
    errors = np.where(moving, errors, np.nan)
    noise = momentum_noise(model, folds, errors, data)
    assert np.all((noise.memory > 0.004) & (noise.memory < 1.0))
    assert 0.25 <= noise.alpha2_kf < 1.0  # a walk that never walks is followed too fast
    rate, prior = np.square(FORCE_RATES["normal"]), np.square(PRIOR)
    judged = replace(model, momentum=noise)
    rows = moving.all(axis=1) & (data.t > 1.0)
    for filters, factor in ((True, noise.alpha2_kf), (False, noise.alpha2_observer)):
        kernel = judged.momentum_kernel(prior, rate, filters=filters)
        F, P, seen, error, variance, *_ = (a[rows] for a in kernel.run(data.q, data.qd, data.tau, data.dt)[:5])
        ratio = (F**2 / np.einsum("kii->ki", P))[seen > 0.9] if filters else error**2 / variance
        assert np.mean(ratio < 4.0) == pytest.approx(0.954, abs=0.02) or factor == 0.25
