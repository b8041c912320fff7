"""Parts of the drives that win on held-out blocks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab import identify
from armlab.errors import NotExcited, ShapeError
from armlab.estimation import Experiment, check_estimator
from armlab.identify import fit_dynamics, fit_friction
from armlab.identify.record import prepare
from armlab.identify.residuals import model_residuals
from armlab.identify.validation import held_out
from armlab.log import Table
from armlab.models import FrictionMap, RippleLines, TorqueModel, load, save, speed_basis
from armlab.robots import from_links


def log(model: TorqueModel, seconds: float, seed: int, noise: float = 0.05) -> Table:
    """Slow free motion of all joints, torque from the model itself."""
    t = np.arange(0, seconds, 0.004)
    rng = np.random.default_rng(seed)
    f = rng.uniform(0.25, 0.45, 7)
    q = 0.9 * np.sin(f * t[:, None]) + 0.05 * np.sin(3.1 * f * t[:, None] + 1.0)
    qd = np.gradient(q, t, axis=0)
    tau = model.torque(q, qd, np.gradient(qd, t, axis=0))
    return Table(t, {"q": q, "qd": qd, "tau": tau + noise * rng.standard_normal(q.shape)})


@pytest.fixture(scope="module")
def rippled(model: TorqueModel) -> TorqueModel:
    """Joint 2 has a line of ripple at 100 cycles/rev, joint 4 friction over position."""
    speeds, widths = speed_basis(0.0, 0.5)
    k = np.zeros((1, 2, 8, 2))
    k[0, 0, :, 0], k[0, 1, :, 1] = 0.3, 0.2  # another phase in the other direction
    lines = RippleLines([1], [100.0], np.tile(speeds, (7, 1)), np.tile(widths, (7, 1)), k)
    q = np.tile(np.linspace(-0.9, 0.9, 200)[:, None], (1, 7))
    basis = identify.rbf_centres(q, np.full(q.shape, 0.3))
    table = np.zeros((7, 2, 8, 5))
    table[3, 0], table[3, 1] = 0.4 * np.sin(3 * basis.positions[3])[:, None], -0.2
    return replace(model, lines=lines, friction_map=FrictionMap(basis, table))


def assert_honest(found: TorqueModel, before: TorqueModel, unseen: Table) -> None:
    """Quality and covariance are what another motion shows: neither those of the model before nor those of the fit."""
    quality, won = found.quality, [1, 3]
    data = prepare(unseen, from_links("arm", found.frames, gravity=found.gravity))
    rows = np.ones(len(unseen), dtype=bool)
    errors, moving = held_out([(found, rows)], data)
    worse, _ = held_out([(before, rows)], data)
    rms, rms_before = (np.sqrt(np.sum(e**2, axis=0, where=moving) / moving.sum(axis=0)) for e in (errors, worse))
    assert np.all(quality.rms_cv[won] > quality.rms[won])
    assert np.all(quality.rms_cv[won] < 0.5 * rms_before[won])
    np.testing.assert_allclose(quality.rms_cv[won], rms[won], rtol=0.4)
    inside = np.mean(errors[:, won] ** 2 < 4.0 * found.covariance.variance(unseen["qd"])[:, won], where=moving[:, won])
    assert 0.85 < inside < 0.995
    np.testing.assert_allclose(quality.coverage[won], 0.954, atol=0.05)


@pytest.mark.slow  # 15 s
def test_what_is_there_is_found_and_nothing_else(tmp_path, model: TorqueModel, rippled: TorqueModel) -> None:
    fit = fit_friction(log(rippled, 40, seed=0), model)
    lines, part = fit.value.lines, fit.value.friction_map
    assert lines is not None
    assert part is not None
    assert lines.joint.tolist() == [1]
    assert lines.cycles[0] == pytest.approx(100.0, abs=0.2)
    assert np.flatnonzero(part.coefficients.any(axis=(1, 2, 3))).tolist() == [3]
    assert fit.value.warm_up is None
    held_out = log(rippled, 30, seed=5, noise=0.0)  # other frequencies
    qdd = np.gradient(held_out["qd"], held_out.t, axis=0)
    exact, before, after = (m.torque(held_out["q"], held_out["qd"], qdd) for m in (rippled, model, fit.value))
    error = np.sqrt(np.mean((after - exact) ** 2, axis=0)) / np.maximum(
        np.sqrt(np.mean((before - exact) ** 2, 0)), 1e-9
    )
    assert error[1] < 0.25
    assert error[3] < 0.25
    assert len(fit.names) == 32 + 1 + 80
    assert fit.names[32] == "ripple joint 2 line 1"
    assert fit.parameters[32] == lines.cycles[0]
    assert "100." in fit.report()
    assert_honest(fit.value, model, log(rippled, 30, seed=5))
    again = load(save(fit.value, tmp_path / "model.toml"))
    assert np.array_equal(again.torque(held_out["q"], held_out["qd"]), fit.value.torque(held_out["q"], held_out["qd"]))


@pytest.mark.slow  # 8 s
def test_noise_adds_nothing(model: TorqueModel) -> None:
    fit = fit_friction(log(model, 20, seed=3), model)
    assert fit.value.lines is None
    assert fit.value.friction_map is None
    assert fit.names == ()
    np.testing.assert_allclose(fit.sigma, 0.05, rtol=0.05)


def test_bad_logs_are_refused(model: TorqueModel) -> None:
    table = log(model, 10, seed=1)
    with pytest.raises(NotExcited, match="5 s"):
        fit_friction(table.between(0.0, 3.0), model)
    with pytest.raises(ShapeError, match="derivative of q"):
        fit_friction(table.with_column("qd", -table["qd"]), model)
    tau = np.array(table["tau"])
    tau[7] = np.nan
    with pytest.raises(ShapeError, match="first"):
        fit_friction(table.with_column("tau", tau), model)


def test_lines_that_the_sampling_hides_are_told_by_joint(model: TorqueModel) -> None:
    """At 50 Hz ripple at twice the gear ratio folds back above 0.7 rad/s or so; the search says for whom."""
    t = np.arange(0, 8, 0.02)
    f = np.where(np.arange(7) == 2, 2.0, 0.2)
    q = 0.9 * np.sin(f * t[:, None])
    qd, qdd = 0.9 * f * np.cos(f * t[:, None]), -0.9 * f**2 * np.sin(f * t[:, None])
    noise = 0.05 * np.random.default_rng(0).standard_normal(q.shape)
    table = Table(t, {"q": q, "qd": qd, "tau": model.torque(q, qd, qdd) + noise})
    with pytest.warns(UserWarning, match=r"faster ripple for joint 3 \(above \d+ cycles/rev\): it folds back"):
        fit_friction(table, model)


class Drives:
    """Ripple of joint 1 and friction over position of joint 2; four times the samples at four times the rate."""

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

    def motion(self, n: int) -> tuple[np.ndarray, ...]:
        t = np.arange(n)[:, None] * 40.0 / n
        waves = [(0.9, self.f, 0.0), (0.1, 3.1 * self.f, 1.0)]
        q = sum(a * np.sin(w * t + p) for a, w, p in waves)
        qd = sum(a * w * np.cos(w * t + p) for a, w, p in waves)
        return t[:, 0], q, qd, sum(-a * w**2 * np.sin(w * t + p) for a, w, p in waves)

    def log(self, truth: TorqueModel, seed: int, n: int) -> Table:
        t, q, qd, qdd = self.motion(n)
        noise = 0.2 * np.random.default_rng(seed).standard_normal((n, 2))
        return Table(t, {"q": q, "qd": qd, "tau": truth.torque(q, qd, qdd) + noise})


@pytest.fixture(scope="module")
def drives(short_arm) -> Drives:
    return Drives(fit_dynamics(short_arm.log(0, 3000), short_arm.robot).value)


@pytest.mark.slow  # 2 s
def test_a_weak_line_is_found_beside_friction_over_position(drives: Drives) -> None:
    """A tenth of the power of the noise: under friction over position at most 4 of 20 logs told it."""
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
    """Lines are fitted where they are slow; the fast rows of a wrist had a residual of ten times the one before."""
    t = np.arange(0.0, 40.0, 0.004)
    q = np.array([0.9, 0.5]) * np.sin(9.0 * drives.f * t[:, None]) * (1.0 + np.sin(1.3 * t))[:, None]
    qd = np.gradient(q, t, axis=0)
    truth = replace(drives.base, lines=replace(drives.lines, coefficients=0.3 * np.asarray(drives.lines.coefficients)))
    tau = truth.torque(q, qd, np.gradient(qd, t, axis=0)) + 0.05 * np.random.default_rng(0).standard_normal(q.shape)
    table = Table(t, {"q": q, "qd": qd, "tau": tau})
    found = fit_friction(table, drives.base)
    assert found.value.lines is not None
    fast = 100.0 * np.abs(qd[:, 0]) > 1.2 * 0.5 * np.pi * 250.0  # rows beyond those that tell the line
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
