"""Records of logs, residuals of a model along them, its thermal state, and the noise models fitted to them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab.errors import NotExcited, ShapeError
from armlab.estimation import Experiment, check_estimator
from armlab.identify import fit_velocity_covariance, prepare, with_velocity
from armlab.identify.record import Record, prepare_share, torque_outliers, without_outliers
from armlab.identify.residuals import BIN, ModelResiduals, friction_signs, model_residuals, relaxed, settled
from armlab.identify.validation import (
    begun,
    held_out,
    known_wrench,
    momentum_noise,
    velocity_noise,
    with_wrench,
)
from armlab.kernels import presliding
from armlab.log import Table
from armlab.models import TorqueModel, velocity_covariance
from armlab.models.friction import WarmUp
from armlab.models.uncertainty import FORCE_RATES, PRIOR


def test_prepare_cuts_at_gaps_and_joins_logs(truth, excited) -> None:
    holed = Table(
        np.delete(excited.t, slice(1000, 1020)),
        {k: np.delete(excited[k], slice(1000, 1020), 0) for k in ("q", "qd", "tau")},
    )
    data = prepare([excited, holed], truth.robot)
    assert isinstance(data, Record)
    N = len(excited)
    assert data.segments == ((0, N), (N, N + 1000), (N + 1000, 2 * N - 20))
    assert data.rate == pytest.approx(250.0)
    np.testing.assert_allclose(data.resolution, 0.5e-5, rtol=1e-3)
    np.testing.assert_allclose(data.dt[[0, 1, N + 1000]], 0.004, rtol=1e-6)
    blocks = data.blocks(1.0)
    assert blocks[0] == 0
    assert np.all(np.diff(blocks) >= 0)
    assert blocks[N + 1000] > blocks[N + 999]
    assert len(data.sources) == 2
    assert excited.sha256 in data.sources[0]


def test_filter_and_differentiate_do_not_reach_across_a_gap(truth, excited) -> None:
    data = prepare([excited, excited.with_column("row", np.arange(len(excited)), unit="1")], truth.robot)
    N = len(excited)
    for result in (data.filter(data.q, 10.0), data.differentiate(data.q)):
        np.testing.assert_array_equal(result[:N], result[N:])


def test_a_sliding_joint_moves_when_it_moves_by_millimetres(truth) -> None:
    """No threshold in degrees holds for a prismatic joint: 30 mm are enough, 10 mm are not; the message uses mm."""
    robot = replace(truth.robot, prismatic=np.arange(7) == 0)
    t = np.arange(0, 10, 0.004)

    def log(stroke: float) -> Table:
        sizes = np.array([stroke, *[1.0] * 6])
        q, qd = 0.5 * sizes * np.sin(t)[:, None], 0.5 * sizes * np.cos(t)[:, None]
        return Table(t, {"q": q, "qd": qd, "tau": q + qd})

    assert prepare(log(0.03), robot).seconds == pytest.approx(9.996)
    with pytest.raises(NotExcited, match=r"10\.0 mm"):
        prepare(log(0.01), robot)


def test_positions_without_velocity_are_refused_by_row_and_too_few_have_none(excited) -> None:
    holes = excited["q"].copy()
    holes[5] = np.nan
    with pytest.raises(ShapeError, match=r"finite q.*first \[5\]"):
        with_velocity(Table(excited.t, {"q": holes}))
    for rows in (0, 1, 50):
        few = with_velocity(Table(excited.t[:rows], {"q": excited["q"][:rows]}))
        assert few["qd"].shape == (rows, 7)
        assert np.isnan(few["qd"]).all()


def test_velocity_is_computed_where_the_log_has_none(truth, excited) -> None:
    """Sampled at ten times the motion's bandwidth, the position derivative is as good as a measured velocity."""
    bare = Table(excited.t, {"q": excited["q"], "tau": excited["tau"]})
    found, given = prepare(bare, truth.robot), prepare(excited, truth.robot)
    assert np.std(found.qd - given.qd) < 2e-3
    assert with_velocity(excited) is excited
    holed = bare.rows(np.abs(np.arange(len(bare)) - 3000) > 20)
    assert np.abs(prepare(holed, truth.robot).qd).max() < 1.05 * np.abs(given.qd).max()
    alone = bare.rows(np.r_[0:50, 200:7500])
    assert np.isnan(with_velocity(alone)["qd"][:50]).all()


def test_of_a_share_joints_may_rest_but_what_is_there_is_checked(short_arm) -> None:
    """Other logs may move these joints. Different rest positions in two logs are not a motion without velocity."""
    logs = [short_arm.log(k, 1000, still={1: position}) for k, position in enumerate((0.0, 0.5))]
    for table in logs:
        with pytest.raises(NotExcited, match="joint_2"):
            prepare(table, short_arm.robot)
        assert prepare_share(table, short_arm.robot).segments == ((0, 1000),)
    assert prepare(logs, short_arm.robot).segments == ((0, 1000), (1000, 2000))
    with pytest.raises(ShapeError, match=r"derivative of q.*joint_1"):
        prepare_share(logs[0].with_column("qd", -logs[0]["qd"]), short_arm.robot)


# Sampling rate and torque outliers.


def test_spikes_are_found_and_replaced_better_by_a_model(short_arm, short_fit) -> None:
    """The median fails where friction reverses; with the model, no replacement is worse than the noise around it."""
    clean, bad = short_arm.log(0, 3000), short_arm.log(0, 3000, bad=0.05)
    data = prepare(bad, short_arm.robot)
    spoilt, found = bad["tau"] != clean["tau"], torque_outliers(data)
    assert np.sum(found & ~spoilt) < 0.02 * found.sum()
    assert found.sum() > 0.98 * spoilt.sum()
    plain = without_outliers(data, found)
    modelled = without_outliers(data, found, short_fit.value)
    for tau in (plain, modelled):
        np.testing.assert_array_equal(tau[~found], bad["tau"][~found])
    first, second = (np.sqrt(np.mean((tau - clean["tau"])[found] ** 2)) for tau in (plain, modelled))
    assert second < 0.9 * first
    noise = np.sqrt(np.mean(np.broadcast_to([0.3, 0.2], found.shape)[found] ** 2))
    assert second == pytest.approx(np.hypot(1.0, 0.5) * noise, rel=0.15), "its own noise, and that of a median of nine"
    assert not torque_outliers(prepare(short_arm.log(1, 3000), short_arm.robot)).any()


# Residuals and thermal state.


def test_residuals_are_measured_minus_modelled_torque(model: TorqueModel, excited: Table) -> None:
    found = model_residuals(excited, model)
    assert isinstance(found, ModelResiduals)
    assert np.all(np.std(found.y, axis=0) < 0.3 * np.std(excited["tau"], axis=0))
    z = presliding(excited["q"], model.friction.delta, model.friction.resolution)
    assert np.array_equal(found.s, z)
    assert np.array_equal(friction_signs(model, found.data), z)
    smooth = replace(model, friction=replace(model.friction, smooth_speed=np.full(7, 0.05)))
    np.testing.assert_allclose(model_residuals(excited, smooth).s, np.tanh(excited["qd"] / 0.05))


def test_constant_power_warms_as_the_law_says() -> None:
    """x(t) = h + (x0 - h) exp(-t / T) in the middle of each second."""
    x = relaxed(np.full(600, 0.7), 150.0, 2.0)
    np.testing.assert_allclose(x, 0.7 + 1.3 * np.exp(-BIN * (np.arange(600) + 0.5) / 150.0), atol=2e-5)


def test_warmth_settles_with_its_own_friction() -> None:
    """With viscous friction power f qd^2 (1 - 0.4 x) at constant speed, x settles at h / (1 + 0.4 h)."""
    k = np.array([2.0, 0.0, 0.0, 0.0, -0.8, 0.0])
    power = np.tile([0.5, 0.0, 0.0], (3000, 1))
    assert settled(power, k, 120.0, 0.0, 1.0)[-1] == pytest.approx(1.0 / 1.4, rel=1e-3)


def test_pieces_begin_as_warm_as_the_log_has_made_them(truth, excited, model) -> None:
    """The torque of a segment alone is that of the whole log, but not without its initial warmth."""
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


# Torque covariance over velocity.


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


@pytest.mark.slow  # 6 s and 1 s
@pytest.mark.parametrize("kind", ["exp", "step"])
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
    """White noise is as informative along a slow sway as at random speeds; correlated noise is less informative."""
    rng = np.random.default_rng(0)
    qd = 0.3 * np.sin(2 * np.pi * np.arange(6000) / 1500.0)[:, None]
    truth = velocity_covariance("exp", [C0], [CINF], [RATE])
    noise = rng.standard_normal((6000, 1)) * np.sqrt(truth.variance(qd))
    drawn = rng.permutation(6000)
    sd = fit_velocity_covariance(noise, qd).sd
    np.testing.assert_allclose(sd, fit_velocity_covariance(noise[drawn], qd[drawn]).sd, rtol=0.1)
    held = np.repeat(rng.standard_normal(600), 10)[:, None] * np.sqrt(truth.variance(qd))
    assert np.all(fit_velocity_covariance(held, qd).sd > 2.5 * sd)


def test_constant_is_the_mean_square() -> None:
    residuals, qd = sample(0, "exp")
    fit = fit_velocity_covariance(residuals, qd, "const")
    np.testing.assert_allclose(fit.value.variance(qd)[0], np.mean(residuals**2, axis=0))


def test_a_step_is_found_between_two_samples_of_speed() -> None:
    """The threshold has no grid: it lies within three samples of the variance jump; without a jump it is unknown."""
    rng = np.random.default_rng(3)
    qd = rng.permutation(np.linspace(0.001, 1.0, 1000))[:, None]
    noise = rng.standard_normal((1000, 1))
    found = fit_velocity_covariance(np.where(qd < 0.3005, 30.0, 1.0) * noise, qd, "step")
    assert found.value.shape[0] == pytest.approx(0.3005, abs=0.003)
    assert 0.8e-3 < found.sd[2] * 0.3005 < 1.5e-3
    assert fit_velocity_covariance(noise, qd, "step").sd[2] > 0.3


def test_what_the_data_do_not_tell_is_uncertain_and_never_exact() -> None:
    """White residuals have no decay rate; joints that are always fast have no variance at rest."""
    rng = np.random.default_rng(0)
    e, qd = rng.standard_normal((2, 2000, 1))
    white = fit_velocity_covariance(e, qd)
    assert white.sd[2] > 0.5
    assert white.excitation.condition > 1.0
    fast = fit_velocity_covariance(e, 5 + 0.1 * qd)
    assert fast.sd[1] > 3.0
    assert np.all(fit_velocity_covariance(e, qd, "step").sd > 0.01)


# Noise of the momentum estimators.


def test_velocity_noise_is_found_under_the_motion(truth, excited) -> None:
    noise = velocity_noise(prepare(excited, truth.robot))
    np.testing.assert_allclose(noise, 1e-3, rtol=0.05)


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
    monkeypatch.setattr("armlab.identify.validation.ENOUGH", len(rows) // 2)
    part = momentum_noise(model, [(model, rows)], errors, data)
    assert part.alpha2_observer != whole.alpha2_observer
    assert part.alpha2_observer == pytest.approx(whole.alpha2_observer, rel=0.2)
    np.testing.assert_array_equal(part.memory, whole.memory)


def test_drift_between_logs_is_not_averaged(truth, excited, model) -> None:
    """In the factors of both estimators, drift counts as a persistent error."""
    data = prepare(excited, truth.robot)
    rows = np.ones(len(data.t), dtype=bool)
    errors, moving = held_out([(model, rows)], data)
    errors = np.where(moving, errors, np.nan)
    drift = 2.0 * np.nanmean(errors**2, axis=0)
    wide = model.covariance
    wide = replace(wide, C0=wide.C0 + drift / wide.alpha2, Cinf=wide.Cinf + drift / wide.alpha2)
    plain = momentum_noise(model, [(model, rows)], errors, data)
    found = momentum_noise(replace(model, covariance=wide), [(model, rows)], errors, data, drift)
    assert plain.alpha2_observer < found.alpha2_observer < 1.2
    assert found.alpha2_kf > momentum_noise(replace(model, covariance=wide), [(model, rows)], errors, data).alpha2_kf


def test_momentum_noise_makes_two_sigma_hold(truth, excited, model) -> None:
    """Two sigma cover 95.4 % on the observable axes of the tuning rows, unless a factor reached its bound."""
    data = prepare(excited, truth.robot)
    rows = np.arange(len(data.t)) < len(data.t) // 2
    folds = [(model, rows), (model, ~rows)]
    errors, moving = held_out(folds, data)
    errors = np.where(moving, errors, np.nan)
    noise = momentum_noise(model, folds, errors, data)
    assert np.all((noise.memory > 0.004) & (noise.memory < 1.0))
    assert 1.0 <= noise.alpha2_kf < 3.0
    rate, prior = np.square(FORCE_RATES["normal"]), np.square(PRIOR)
    judged = replace(model, momentum=noise, gain_cov=0 * model.gain_cov, load_sd=np.zeros(7))
    rows = moving.all(axis=1) & (data.t > 1.0)
    for filters, factor in ((True, noise.alpha2_kf), (False, noise.alpha2_observer)):
        kernel = judged.momentum_kernel(prior, rate, filters=filters)
        tau = with_wrench(judged, data, 0, len(data.t)) if filters else data.tau  # a known wrench
        F, P, seen, error, variance, *_ = (a[rows] for a in kernel.run(data.q, data.qd, tau, data.dt)[:5])
        missed = F - known_wrench(data.t[rows])
        ratio = (missed**2 / np.einsum("kii->ki", P))[seen > 0.9] if filters else error**2 / variance
        assert np.mean(ratio < 4.0) == pytest.approx(0.954, abs=0.02) or factor in (0.25, 1.0)
