"""Friction over position and speed, ripple lines, warm-up, and the regularised regressions behind them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab import identify
from armlab.estimation import Experiment, Fit, check_estimator
from armlab.identify import fit_friction, fit_warm_up, rbf_centres, rbf_regressor, ripple_lines
from armlab.identify.drives.regularised import GroupLasso, LassoSums, group_lasso, refit, ridge_solution, select_groups
from armlab.identify.drives.ripple import (
    highest_seen,
    refine_lines,
    ripple_amplitudes,
    ripple_regressor,
    warn_of_fast_lines,
)
from armlab.identify.record import prepare
from armlab.identify.residuals import model_residuals
from armlab.identify.validation import held_out
from armlab.log import Table
from armlab.models import TorqueModel, load, save
from armlab.models.friction import FrictionMap, RippleLines, WarmUp, speed_basis
from armlab.robots import from_links


def test_lines_that_the_sampling_hides_are_told_by_joint(model: TorqueModel) -> None:
    """At 50 Hz, ripple at twice the gear ratio aliases above about 0.7 rad/s; the search names the joints."""
    t = np.arange(0, 8, 0.02)
    f = np.where(np.arange(7) == 2, 2.0, 0.2)
    q = 0.9 * np.sin(f * t[:, None])
    qd, qdd = 0.9 * f * np.cos(f * t[:, None]), -0.9 * f**2 * np.sin(f * t[:, None])
    noise = 0.05 * np.random.default_rng(0).standard_normal(q.shape)
    table = Table(t, {"q": q, "qd": qd, "tau": model.torque(q, qd, qdd) + noise})
    with pytest.warns(UserWarning, match=r"faster ripple for joint 3 \(above \d+ cycles/rev\): it aliases"):
        fit_friction(table, model)


class Drives:
    """Ripple of joint 1 and friction over position of joint 2; four times the samples means four times the rate."""

    f = np.array([0.4, 0.53])

    def __init__(self, base: TorqueModel) -> None:
        self.base = replace(base, ripple=replace(base.ripple, cycles=np.array([100.0, 100.0])))
        _, q, qd, _ = self.motion(4000)
        spread = [speed_basis(0.0, float(peak), 8) for peak in np.abs(qd).max(axis=0)]
        speeds, widths = (np.stack([one[k] for one in spread]) for k in range(2))
        ripple, basis, over = np.zeros((1, 2, 8, 2)), identify.rbf_centres(q, qd), np.zeros((2, 2, 8, 5))
        ripple[0, 0, :, 0], ripple[0, 1, :, 1] = 0.8, 0.7
        over[1, 0], over[1, 1] = 0.4 * np.sin(3 * basis.positions[1])[:, None], -0.2
        self.lines, self.map = RippleLines([0], [100.0], speeds, widths, ripple), FrictionMap(basis, over)
        self.parameters = np.concatenate([ripple.ravel(), [100.0], over[1].ravel()])

    def motion(self, n: int, faster: float = 1.0) -> tuple[np.ndarray, ...]:
        t, f = np.arange(n)[:, None] * 40.0 / n, faster * self.f
        waves = [(0.9, f, 0.0), (0.1, 3.1 * f, 1.0)]
        q = sum(a * np.sin(w * t + p) for a, w, p in waves)
        qd = sum(a * w * np.cos(w * t + p) for a, w, p in waves)
        return t[:, 0], q, qd, sum(-a * w**2 * np.sin(w * t + p) for a, w, p in waves)

    def log(self, truth: TorqueModel, seed: int, n: int, faster: float = 1.0, noise: float = 0.2) -> Table:
        t, q, qd, qdd = self.motion(n, faster)
        e = noise * np.random.default_rng(seed).standard_normal((n, 2))
        return Table(t, {"q": q, "qd": qd, "tau": truth.torque(q, qd, qdd) + e})


@pytest.fixture(scope="module")
def drives(short_fit) -> Drives:
    return Drives(short_fit.value)


def assert_honest(found: TorqueModel, before: TorqueModel, unseen: Table) -> None:
    """Quality and covariance match another motion, not the previous model or the fitted data."""
    quality, data = found.quality, prepare(unseen, from_links("arm", found.frames, gravity=found.gravity))
    rows = np.ones(len(unseen), dtype=bool)
    errors, moving = held_out([(found, rows)], data)
    worse, _ = held_out([(before, rows)], data)
    rms, rms_before = (np.sqrt(np.sum(e**2, axis=0, where=moving) / moving.sum(axis=0)) for e in (errors, worse))
    assert np.all(quality.rms_cv > quality.rms)
    assert np.all(quality.rms_cv < 0.5 * rms_before)
    np.testing.assert_allclose(quality.rms_cv, rms, rtol=0.4)
    assert 0.85 < np.mean(errors**2 < 4.0 * found.covariance.variance(unseen["qd"]), where=moving) < 0.995
    np.testing.assert_allclose(quality.coverage, 0.954, atol=0.05)


@pytest.mark.parametrize("seed", range(3))
def test_friction_over_position_and_ripple_are_no_delay(drives: Drives, seed: int) -> None:
    """Without columns for friction over position in the survey, the torque of these logs was shifted by 0.11 s."""
    truth = replace(drives.base, lines=drives.lines, friction_map=drives.map)
    assert not model_residuals(drives.log(truth, seed, 4000, noise=0.1), drives.base).data.delays


@pytest.mark.slow  # 3 s
def test_what_is_there_is_found_and_nothing_else(tmp_path, drives: Drives) -> None:
    before, truth = drives.base, replace(drives.base, lines=drives.lines, friction_map=drives.map)
    fit = fit_friction(drives.log(truth, 0, 8000, noise=0.1), before)
    lines, part = fit.value.lines, fit.value.friction_map
    assert lines is not None
    assert part is not None
    assert lines.joint.tolist() == [0]
    assert lines.cycles[0] == pytest.approx(100.0, abs=0.2)
    assert np.flatnonzero(part.coefficients.any(axis=(1, 2, 3))).tolist() == [1]
    assert fit.value.warm_up is None
    unseen = drives.log(truth, 1, 8000, faster=0.83, noise=0.0)
    qdd = np.gradient(unseen["qd"], unseen.t, axis=0)
    exact, plain, found = (m.torque(unseen["q"], unseen["qd"], qdd) for m in (truth, before, fit.value))
    assert np.all(np.sum((found - exact) ** 2, axis=0) < 0.25**2 * np.sum((plain - exact) ** 2, axis=0))
    assert len(fit.names) == 32 + 1 + 80
    assert fit.names[32] == "ripple joint 1 line 1"
    assert fit.parameters[32] == lines.cycles[0]
    assert "100." in fit.report()
    assert_honest(fit.value, before, drives.log(truth, 5, 8000, faster=0.83, noise=0.1))
    again = load(save(fit.value, tmp_path / "model.toml"))
    assert np.array_equal(again.torque(unseen["q"], unseen["qd"]), fit.value.torque(unseen["q"], unseen["qd"]))


@pytest.mark.slow  # 2 s
def test_noise_adds_nothing(drives: Drives) -> None:
    fit = fit_friction(drives.log(drives.base, 3, 4000), drives.base)
    assert fit.value.lines is None
    assert fit.value.friction_map is None
    assert fit.names == ()
    np.testing.assert_allclose(fit.sigma, 0.2, rtol=0.05)


@pytest.mark.slow  # 2 s
def test_a_weak_line_is_found_beside_friction_over_position(drives: Drives) -> None:
    """At a tenth of the noise power, masked by friction over position, the line was found in at most 4 of 20 logs."""
    weak = replace(drives.lines, coefficients=0.12 * np.asarray(drives.lines.coefficients))
    over = replace(drives.map, coefficients=np.asarray(drives.map.coefficients)[::-1])
    truth = replace(drives.base, lines=weak, friction_map=over)
    for seed in range(2):
        found = fit_friction(drives.log(truth, seed, 4000), drives.base).value
        assert found.lines is not None
        np.testing.assert_allclose(found.lines.cycles, [100.0], atol=0.5)
        assert found.friction_map is not None


@pytest.mark.slow  # 2 s
def test_no_ripple_is_made_up_for_speeds_at_which_none_is_seen(drives: Drives) -> None:
    """Lines are fitted at low speeds only; the residual of a wrist's fast rows once became ten times larger."""
    t = np.arange(0.0, 40.0, 0.004)
    q = np.array([0.9, 0.5]) * np.sin(9.0 * drives.f * t[:, None]) * (1.0 + np.sin(1.3 * t))[:, None]
    qd = np.gradient(q, t, axis=0)
    truth = replace(drives.base, lines=replace(drives.lines, coefficients=0.3 * np.asarray(drives.lines.coefficients)))
    tau = truth.torque(q, qd, np.gradient(qd, t, axis=0)) + 0.05 * np.random.default_rng(0).standard_normal(q.shape)
    table = Table(t, {"q": q, "qd": qd, "tau": tau})
    found = fit_friction(table, drives.base)
    assert found.value.lines is not None
    fast = 100.0 * np.abs(qd[:, 0]) > 1.2 * 0.5 * np.pi * 250.0  # rows too fast to determine the line
    assert fast.sum() > 100
    before, after = (model_residuals(table, model).y[:, 0] for model in (drives.base, found.value))
    assert np.std(after[~fast]) < 0.7 * np.std(before[~fast])
    assert np.std(after[fast]) < np.std(before[fast])


@pytest.mark.slow  # 12 s
def test_the_statistical_contract(drives: Drives) -> None:
    base, truth = drives.base, replace(drives.base, lines=drives.lines, friction_map=drives.map)

    def draw(seed: int, n: int) -> Experiment:
        return Experiment({"table": drives.log(truth, seed, n), "model": base}, drives.parameters)

    contract = check_estimator(
        fit_friction,
        draw,
        3,
        n=4000,
        noise_given=False,
        refusals={"everything": {"table": draw(0, 4000).data["table"].between(0.0, 3.0), "model": base}},
        skip={
            "efficient": "residuals of robots are coloured: there is no bound to reach",
            "order-free": "friction remembers: the rows of a log have an order",
            "gauge-free": "parameters are those of the drives",
            "robust": "fit_dynamics takes care of outliers before",
            "explains": "the report is a table per joint; the table of the fit has every value",
        },
    )
    assert contract.passed, contract.text()


# Friction over position and speed.


def motion(n: int = 2, N: int = 4000) -> tuple[np.ndarray, np.ndarray]:
    t = np.linspace(0, 40, N)[:, None]
    f = 1.0 + 0.37 * np.arange(n)
    return np.sin(f * t) + 0.5 * np.sin(2.3 * f * t), f * np.cos(f * t) + 1.15 * f * np.cos(2.3 * f * t)


def test_centres_are_mirrored_speeds_of_each_joint() -> None:
    q, qd = motion()
    basis = rbf_centres(q, qd * [1.0, 3.0])
    assert np.all(basis.speeds > 0)
    assert basis.speeds[1, -1] == pytest.approx(3 * np.abs(qd[:, 1]).max())
    np.testing.assert_allclose(rbf_centres(-q, -qd).speeds, rbf_centres(q, qd).speeds)
    constant = np.sign(qd)  # quantiles of a constant speed coincide
    assert np.all(np.diff(rbf_centres(q, constant).speeds) > 0)


def test_it_equals_the_ancestors_formula_between_the_centres() -> None:
    """Scattered centres on both sides of zero, without functions of the opposite sign, normalised by their sum."""
    q, qd = motion(1)
    basis = rbf_centres(q, qd)
    inside = np.flatnonzero(np.abs(qd[:, 0]) > basis.speeds[0, 0])[:500]
    x, v = q[inside, 0], qd[inside, 0]
    P, V = np.meshgrid(basis.positions[0], basis.speeds[0], indexing="ij")
    W, U = np.meshgrid(basis.position_widths[0], basis.speed_widths[0], indexing="ij")
    centres = np.concatenate([np.stack([P, s * V, W, U], axis=-1).reshape(-1, 4) for s in (1, -1)])
    phi = np.exp(
        -(((x[:, None] - centres[:, 0]) / centres[:, 2]) ** 2) - ((v[:, None] - centres[:, 1]) / centres[:, 3]) ** 2
    )
    phi *= np.sign(centres[:, 1]) == np.sign(v)[:, None]
    phi /= phi.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(rbf_regressor(q, qd, basis)[inside, 0], phi, rtol=0, atol=1e-6)


# Torque ripple lines.


RATE = 250.0


def motion_of_ripple(seconds: float = 30.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Slow motion over 0.6 turns; time, position, velocity."""
    t = np.arange(0, seconds, 1 / RATE)
    return t, 1.9 * np.sin(0.3 * t) + 0.1 * np.sin(1.7 * t), 0.57 * np.cos(0.3 * t) + 0.17 * np.cos(1.7 * t)


def test_lines_are_found_to_a_twentieth_of_their_width() -> None:
    _, q, qd = motion_of_ripple(20.0)
    rng = np.random.default_rng(0)
    y = 0.2 * np.cos(100.0 * q + 0.4) + 0.1 * np.cos(202.0 * q) * (0.5 + np.abs(qd)) + 0.1 * rng.standard_normal(len(q))
    found = ripple_lines(q, qd, y, RATE, 250.0)
    width = 2 * np.pi / np.ptp(q)
    assert len(found) == 2
    np.testing.assert_allclose(found, [100.0, 202.0], rtol=0, atol=0.05 * width)


@pytest.mark.slow  # 5 s
def test_noise_has_no_lines() -> None:
    _, q, qd = motion_of_ripple(12.0)
    rng = np.random.default_rng(1)
    false = sum(len(ripple_lines(q, qd, rng.standard_normal(len(q)), RATE, 100.0)) > 0 for _ in range(60))
    assert false <= 3


def test_lines_that_pass_too_fast_are_refused() -> None:
    """At 5 rad/s, a line of 100 cycles/rev is at 80 Hz, above 62.5 Hz, a quarter of the sampling rate."""
    q = motion_of_ripple()[1]
    y = 0.2 * np.cos(100.0 * q)
    fast = np.full(len(q), 5.0)
    assert highest_seen(fast, RATE) == pytest.approx(2 * np.pi * 62.5 / 5.0)
    with pytest.warns(UserWarning, match=r"below 62\.5 Hz.*this joint \(above 79 cycles/rev\)"):
        found = ripple_lines(q, fast, y, RATE, 250.0)
    assert not np.any(np.abs(found - 100.0) < 5.0)
    with pytest.warns(UserWarning, match=r"joint 2 \(above 30 cycles/rev\).*slower motion"):
        warn_of_fast_lines({"joint 2": 30.0}, RATE)


def test_a_short_range_or_no_gear_has_no_lines() -> None:
    _, q, qd = motion_of_ripple()
    assert len(ripple_lines(1e-3 * q, 1e-3 * qd, np.cos(100 * q), RATE, 250.0)) == 0
    assert len(ripple_lines(q, qd, np.cos(100 * q), RATE, 1.0)) == 0


def test_a_line_is_refined_with_all_its_amplitudes_and_its_error_is_told() -> None:
    """Amplitudes over speed and direction, search off by 0.1, 20 logs: errors are as large as stated."""
    t, q, qd = motion_of_ripple(20.0)
    speeds, widths = speed_basis(0.0, np.abs(qd).max(), 3)
    amplitudes, block = ripple_amplitudes(qd, np.sign(qd), speeds, widths), (t / 0.5).astype(int)
    A = ripple_regressor(q, qd, np.sign(qd), np.array([100.0]), speeds, widths)
    truth = np.array([0.3, 0.0, 0.3, 0.1, 0.2, 0.0, 0.0, 0.3, 0.1, 0.3, 0.0, 0.2])
    rng, nees = np.random.default_rng(5), []
    for _ in range(20):
        y = A @ truth + 0.1 * rng.standard_normal(len(q))
        cycles, columns, slopes = refine_lines(q, amplitudes, y, np.array([100.1]))
        x, cov = refit(columns, y, block, beside=slopes)
        assert cycles[0] == pytest.approx(100.0, abs=5.0 * np.sqrt(cov[-1, -1]))
        e = np.append(x - truth, cycles - 100.0)
        nees.append(e @ np.linalg.solve(cov, e) / 13)
    assert 0.7 < np.mean(nees) < 1.3
    np.testing.assert_allclose(ridge_solution(A, A @ truth)[0], truth, atol=1e-4)


# Group lasso.


def problem(seed: int, N: int = 60, groups: int = 5, size: int = 3) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((N, groups * size)) @ np.diag(rng.uniform(0.3, 3, groups * size))
    x = np.zeros(groups * size)
    x[: 2 * size] = rng.standard_normal(2 * size)
    return A, A @ x + 0.3 * rng.standard_normal(N)


@pytest.mark.parametrize(("seed", "penalty"), [(0, 0.5), (1, 5.0), (2, 30.0)])
def test_the_objective_is_that_of_an_independent_solver(seed: int, penalty: float) -> None:
    """Newton's method would stop at the corners of the norms; ever tighter quadratic upper bounds do not."""
    A, y = problem(seed)
    found = group_lasso(LassoSums.of(A, y), 3, penalty, np.zeros(15))
    threshold = penalty * np.sqrt(3)
    x = np.linalg.lstsq(A, y, rcond=None)[0]
    for corner in np.geomspace(1.0, 1e-10, 3000):
        norms = np.sqrt(np.sum(x.reshape(-1, 3) ** 2, axis=1) + corner**2)
        x = np.linalg.solve(A.T @ A + np.diag(np.repeat(threshold / norms, 3)), A.T @ y)
    least = 0.5 * np.sum((y - A @ x) ** 2) + threshold * np.linalg.norm(x.reshape(-1, 3), axis=1).sum()
    assert isinstance(found, GroupLasso)
    assert found.gap <= 1e-6
    assert found.objective <= least * (1 + 1e-6)
    assert found.objective == pytest.approx(least, rel=1e-5)


def test_noise_selects_no_group() -> None:
    rng = np.random.default_rng(3)
    A, y = rng.standard_normal((300, 24)), rng.standard_normal(300)
    assert not select_groups(A, y, 4, np.arange(300) // 10).any()
    assert not select_groups(A, np.zeros(300), 4, np.arange(300) // 10).any()


# Ridge regression on coloured residuals.


def test_few_blocks_leave_no_direction_without_spread() -> None:
    """32 coefficients and 20 blocks of correlated residuals: the scatter alone would have rank 20."""
    rng = np.random.default_rng(4)
    A, block = np.repeat(rng.standard_normal((200, 32)), 10, axis=0), np.arange(2000) // 100
    A = A + 0.5 * rng.standard_normal(A.shape)
    nees = []
    for _ in range(15):
        e = np.repeat(rng.standard_normal(200), 10) + 0.1 * rng.standard_normal(2000)
        x, cov = refit(A, e, block)
        nees.append(x @ np.linalg.solve(cov, x) / 32)
    assert np.linalg.matrix_rank(cov) == 32
    assert 0.7 < np.mean(nees) < 1.4


# Warm-up.


OWN = ("viscous", "coulomb_pos", "coulomb_neg", "offset")
WARM_RATE = 50.0


def warm_log(model: TorqueModel, minutes: float, seed: int) -> Table:
    """Free motion with speeds that change over minutes, torque from the model itself."""
    t = np.arange(0, 60 * minutes, 1 / WARM_RATE)
    rng = np.random.default_rng(seed)
    slow = 0.6 + 0.4 * np.sin(2 * np.pi * t / rng.uniform(300, 500))[:, None]
    phase = np.cumsum(slow * (1.0 + 0.15 * np.arange(7)), axis=0) / WARM_RATE
    q = 0.8 * np.sin(phase)
    qd = np.gradient(q, t, axis=0)
    tau = model.torque(q, qd, np.gradient(qd, t, axis=0), np.full(len(t), 1 / WARM_RATE))
    return Table(t, {"q": q, "qd": qd, "tau": tau + 0.05 * rng.standard_normal(q.shape)})


@pytest.fixture(scope="module")
def cold(model: TorqueModel) -> TorqueModel:
    """The model with large viscous friction in joints 1 and 2."""
    viscous = np.array(model.friction.viscous)
    viscous[:2] = 4.0
    return replace(model, friction=replace(model.friction, viscous=viscous))


@pytest.mark.slow  # 20 s
def test_a_warm_up_of_40_minutes_is_found(cold: TorqueModel) -> None:
    """Viscous friction falls by 0.4 with a time constant of 12 min, found to 25 %; the held-out error is halved."""
    warm, still = np.zeros(7), np.ones(7)
    of_viscous, time = warm.copy(), warm.copy()
    of_viscous[:2], time[:2] = -0.4, 720.0
    truth = replace(cold, warm_up=WarmUp(warm, of_viscous, time, 0.5 * still, warm))
    fit = fit_warm_up(warm_log(truth, 40, seed=0), cold)
    found = fit.value.warm_up
    assert found is not None
    assert np.flatnonzero(found.time).tolist() == [0, 1]
    np.testing.assert_allclose(found.time[:2], 720.0, rtol=0.25)
    held_out = warm_log(truth, 40, seed=1)
    qdd = np.gradient(held_out["qd"], held_out.t, axis=0)
    before, after, exact = (
        model.torque(held_out["q"], held_out["qd"], qdd, held_out.dt)[:, :2] for model in (cold, fit.value, truth)
    )
    assert np.sqrt(np.mean((after - exact) ** 2)) < 0.5 * np.sqrt(np.mean((before - exact) ** 2))
    quality = fit.value.quality
    assert np.all(quality.rms_cv[:2] >= quality.rms[:2])
    assert np.all(quality.rms_cv[:2] < 0.5 * np.std(after - before, axis=0)), "without warm-up much more is left"
    np.testing.assert_allclose(quality.coverage, 0.954, atol=0.05)
    assert len(fit.names) == 16
    assert np.all(fit.sd > 0)


SECONDS = 1206.0
CHANGE = np.array([-0.4, -0.2, 400.0, 0.1])  # of viscous and Coulomb friction, time constant, warmth at the start
POWER = 2.0


def difference(fit: Fit[TorqueModel], truth: np.ndarray) -> np.ndarray:
    """Errors of a fit whose warmth equals 1 at a different power than in the truth."""
    assert fit.value.warm_up is not None
    ratio = POWER / fit.value.warm_up.power[0]
    return fit.parameters - truth * [1, 1, 1, 1, 1 / ratio, 1 / ratio, 1, ratio]


@pytest.mark.slow  # 20 s
def test_the_statistical_contract_of_warm_up(short_fit) -> None:
    """One joint of two warms up for 20 minutes; four times the samples means four times the rate."""
    cold = short_fit.value
    own = np.array([4.0, 2.0, 2.0, 0.3])
    friction = {name: np.array([value, 0.5 * value]) for name, value in zip(OWN, own)}
    cold = replace(cold, friction=replace(cold.friction, **friction))
    of_coulomb, of_viscous, time, start = (np.array([x, 0.0]) for x in CHANGE[[1, 0, 2, 3]])
    truth = replace(cold, warm_up=WarmUp(of_coulomb, of_viscous, time, np.full(2, POWER), start))
    motions: dict[int, Table] = {}

    def draw(seed: int, n: int) -> Experiment:
        t = np.arange(n) * SECONDS / n
        if n not in motions:
            phase = 0.6 * t - 200 / (2 * np.pi) * np.cos(2 * np.pi * t / 400)  # fast and slow for minutes each
            q = 0.8 * np.sin(phase[:, None] * [1.5, 1.9])
            qd = np.gradient(q, t, axis=0)
            tau = truth.torque(q, qd, np.gradient(qd, t, axis=0), np.full(n, SECONDS / n))
            motions[n] = Table(t, {"q": q, "qd": qd, "tau": tau})
        clean = motions[n]
        tau = clean["tau"] + 0.1 * np.random.default_rng(seed).standard_normal((n, 2))
        return Experiment({"table": clean.with_column("tau", tau), "model": cold}, np.concatenate([own, CHANGE]))

    n = int(40 * SECONDS)
    contract = check_estimator(
        fit_warm_up,
        draw,
        8,
        n=n,
        error=difference,
        noise_given=False,
        refusals={"warm-up": {"table": draw(0, n).data["table"].between(0.0, 600.0), "model": cold}},
        skip={
            "efficient": "residuals of robots are coloured: there is no bound to reach",
            "order-free": "warmth remembers: the rows of a log have an order",
            "gauge-free": "parameters are those of the drives",
            "robust": "fit_dynamics takes care of outliers before",
        },
    )
    assert contract.passed, contract.text()
