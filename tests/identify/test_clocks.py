"""Clocks of logs: jitter, lost rows, delays. Torques with a wrong unit, sign or scale. Joints that rest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab.dynamics import base_parameters
from armlab.errors import ShapeError
from armlab.estimation import Fit
from armlab.identify import fit_dynamics, fit_friction, friction_run, prepare
from armlab.identify.clocks import Clock, delay_of
from armlab.identify.plausibility import check_gains, check_torques
from armlab.identify.record import prepare_share
from armlab.identify.regression import Design
from armlab.identify.solve import calibrated
from armlab.identify.validation import held_out
from armlab.kernels import presliding
from armlab.log import Table
from armlab.models import TorqueModel
from tests.conftest import DELTA, NOISE


def jittered(table: Table, share: float, seed: int = 0) -> Table:
    """The log with timestamps jittered by a share of the period."""
    rng = np.random.default_rng(seed)
    period = float(np.median(np.diff(table.t)))
    return Table(table.t + share * period * rng.standard_normal(len(table)).clip(-3, 3), dict(table.values))


def thinned(table: Table, share: float, seed: int = 0) -> Table:
    """The log with a share of its rows removed."""
    return table.rows(np.random.default_rng(seed).uniform(size=len(table)) >= share)


def late(table: Table, seconds: float, name: str = "tau") -> Table:
    """The log with one column delayed by some seconds."""
    return table.with_column(name, np.stack([np.interp(table.t - seconds, table.t, x) for x in table[name].T], axis=1))


def scaled(table: Table, **factors: float) -> Table:
    """The log with joint torques scaled by factors: j2=0.5 halves that of the second joint."""
    own = np.ones(table["tau"].shape[1])
    for joint, factor in factors.items():
        own[int(joint[1:]) - 1] = factor
    return table.with_column("tau", own * table["tau"])


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("stalls", [False, True], ids=["jitter", "stalls"])
def test_rows_are_numbered_as_they_were_sampled(seed: int, stalls: bool) -> None:
    """Timestamps off by a tenth of the period and every twentieth row lost, or rows delayed by a stalled network."""
    rng = np.random.default_rng(seed)
    n, period = 8000, 0.001
    kept = np.flatnonzero(rng.uniform(size=n) > (0.002 if stalls else 0.05))
    even = period * (1.0 + 2e-5) * kept + 12.0
    t = even + 0.1 * period * rng.uniform(-1, 1, len(kept))
    if stalls:  # up to 9 ms; queued rows arrive 0.3 ms apart
        for k in rng.choice(len(kept) - 50, 40, replace=False):
            t[k:] = np.maximum(t[k:], t[k] + rng.uniform(0.003, 0.009) + 0.3 * period * np.arange(len(t) - k))
        t = np.maximum.accumulate(t + 1e-9 * np.arange(len(t)))
    clock = Clock.of(t)
    wrong = clock.index != kept - kept[0]  # which row was lost in a stall is unknown
    assert wrong.mean() < (0.003 if stalls else 1e-9)
    assert clock.index[-1] == kept[-1] - kept[0]
    assert clock.retimed
    assert np.abs(clock.t - even)[~wrong].max() < 0.3 * period
    assert np.std(np.diff(clock.t) / np.diff(kept)) < 0.02 * period
    assert clock.period == pytest.approx(period * (1.0 + 2e-5), rel=1e-5 if not stalls else 1e-4)


def test_an_even_clock_stays_as_it_is(excited) -> None:
    clock = Clock.of(excited.t)
    assert clock.t is excited.t
    assert (clock.lost, clock.text()) == (0, "")


def test_rows_that_were_sampled_unevenly_keep_their_stamps() -> None:
    """Positions that follow uneven timestamps were sampled unevenly; evenly sampled ones get the even clock."""
    even = np.arange(1000) * 0.01
    stamps = even + 0.002 * np.random.default_rng(0).uniform(-1, 1, 1000)
    for sampled in (stamps, even):
        q, qd = np.sin(3 * sampled)[:, None], 3 * np.cos(3 * sampled)[:, None]
        assert Clock.of(stamps, q, qd).retimed == (sampled is even)


def test_jitter_and_lost_rows_leave_the_record(truth, excited) -> None:
    """Jitter of a tenth of the period, every twentieth row lost: other rows are unchanged, lost rows do not count."""
    bad = thinned(jittered(excited, 0.1), 0.05)
    found, clean = prepare(bad, truth.robot), prepare(excited, truth.robot)
    assert len(found.segments) == 1
    assert found.measured == len(bad)
    assert len(found.bridged) == len(found.t) - len(bad) == pytest.approx(0.05 * len(excited), rel=0.2)
    assert np.abs(np.diff(found.t) - 0.004).max() < 0.02 * 0.004
    np.testing.assert_array_equal(found.resolution, clean.resolution)
    assert np.std(found.q - clean.q[: len(found.t)]) < 1e-4
    slope, expected = (one.filter(one.differentiate(one.qd), 10.0) for one in (found, clean))
    assert np.std(slope - expected[: len(slope)]) < 0.03 * np.std(expected)
    assert "timestamps jitter by 0.4 ms" in found.notes[0]
    assert "rows are lost (5" in found.notes[0]


def test_rows_that_resampling_left_empty_are_lost_rows(truth, excited) -> None:
    holed = thinned(excited, 0.05).resample(250.0, max_gap=0.005)
    assert np.isnan(holed["q"]).any()
    found = prepare(holed, truth.robot)
    assert np.isfinite(found.tau).all()
    assert found.measured <= np.count_nonzero(np.isfinite(holed["tau"]).all(axis=1))


def test_the_result_of_a_spoilt_clock_is_the_clean_one(short_arm, short_fit) -> None:
    table = thinned(jittered(short_arm.log(0, 3000), 0.1), 0.05)
    fit, p = fit_dynamics(table, short_arm.robot), len(short_fit.value.base_names)
    assert np.all(np.abs(fit.value.base_values - short_fit.value.base_values) < 0.3 * short_fit.sd[:p])
    np.testing.assert_allclose(fit.value.quality.rms_cv, short_fit.value.quality.rms_cv, rtol=0.1)
    assert fit.n == len(table)
    assert "rows are lost" in fit.report()


# Delays.


@pytest.mark.parametrize("seconds", [-0.04, 0.004, 0.05, 0.3])
def test_a_late_torque_is_named_and_taken_back(truth, excited, seconds: float) -> None:
    found = prepare(late(excited, seconds), truth.robot)
    delay = found.delays["tau"]
    assert abs(delay.seconds - seconds) < min(0.002, 3.0 * delay.sd)
    clean, lost = prepare(excited, truth.robot), max(0, int(np.ceil(-250 * delay.seconds)))
    band = slice(100, len(found.t) - 100)
    error = found.filter(found.tau, 8.0)[band] - clean.filter(clean.tau, 8.0)[lost:][band]
    assert np.all(np.std(error, axis=0) < 0.03 * np.std(clean.tau, axis=0))


def test_a_late_velocity_is_named_and_taken_back(truth, excited) -> None:
    found = prepare(late(excited, 0.05, "qd"), truth.robot)
    assert found.delays["qd"].seconds == pytest.approx(0.05, abs=0.002)
    assert "tau" not in found.delays
    assert np.std(found.qd - prepare(excited, truth.robot).qd[: len(found.t)]) < 2e-3


def test_delays_of_many_logs_lie_within_their_deviations(short_arm) -> None:
    """Twenty logs on time: no delay is reported. Twenty 50 ms late: all are reported, at least 18 within two SD."""
    logs = [short_arm.log(seed, 3000) for seed in range(20)]
    assert not any(prepare(table, short_arm.robot).delays for table in logs)
    found = [prepare(late(table, 0.05), short_arm.robot).delays["tau"] for table in logs]
    off = np.array([(one.seconds - 0.05) / one.sd for one in found])
    assert np.sum(np.abs(off) < 2.0) >= 18
    assert max(one.sd for one in found) < 0.003


@pytest.mark.parametrize("drift", [0.05, 0.15])
def test_a_slow_drift_does_not_hide_a_delay(drift: float) -> None:
    """Drift of several times the noise."""
    rate, t = 100.0, np.arange(6000) * 0.01
    rows, motion = np.arange(100, 5900, 4), np.sin(2.0 * t + np.sin(0.7 * t))
    basis = np.linalg.qr(np.stack([motion[rows], np.ones(len(rows))], axis=1))[0]
    noisy = np.roll(motion, 5) + 0.02 * np.random.default_rng(0).standard_normal(len(t))
    torque = noisy + drift * np.sin(2 * np.pi * t / 80.0)
    delay = delay_of(torque[:, None], [basis], rows, rate, np.ones(1, dtype=bool))
    assert delay is not None
    assert delay.matters(1.0 / rate)
    assert abs(delay.seconds - 0.05) < 2.0 * delay.sd


def test_a_fit_says_how_late_its_torque_was(short_arm, short_fit) -> None:
    """The model is that of the log on time; the delay is reported, since estimators do not compensate for it."""
    fit, p = fit_dynamics(late(short_arm.log(0, 3000), 0.3), short_arm.robot), len(short_fit.value.base_names)
    assert np.all(np.abs(fit.value.base_values - short_fit.value.base_values) < 0.3 * short_fit.sd[:p])
    np.testing.assert_allclose(fit.value.quality.rms_cv, short_fit.value.quality.rms_cv, rtol=0.1)
    (said,) = fit.doubts
    assert said.startswith("torque is 30")
    assert said in fit.report()


@pytest.mark.slow  # 15 s
def test_a_friction_run_of_the_product_is_fitted(truth, model) -> None:
    """One joint at ten speeds, the others at rest: its friction is fitted again, theirs stays."""
    found = fit_friction(truth.log(friction_run(truth.robot, 0), seed=2), model)
    assert 0.9 < found.value.quality.coverage[0] < 1.0
    assert found.value.quality.rms_cv[0] < 0.1 * truth.friction.coulomb_pos[0]
    np.testing.assert_array_equal(found.value.friction.coulomb_pos[1:], model.friction.coulomb_pos[1:])
    np.testing.assert_array_equal(found.value.quality.rms_cv[1:], model.quality.rms_cv[1:])


# Plausibility.


@pytest.fixture(scope="module")
def massive(truth):
    """The arm with masses in its description that are off by up to a fifth."""
    return replace(truth.robot, inertias=np.linspace(0.9, 1.2, 7)[:, None] * truth.links)


def doubts(table: Table, robot, force: bool = False) -> tuple[str, ...]:
    return check_torques(prepare(table, robot), robot, np.ones(robot.n, dtype=bool), force)


def test_torques_as_they_should_be_raise_no_doubt(truth, massive, excited, short_arm) -> None:
    assert doubts(excited, massive) == doubts(excited, truth.robot) == ()
    for seed in range(10):
        assert doubts(short_arm.log(seed, 3000), short_arm.robot) == ()


@pytest.mark.parametrize(("factors", "words"), [
    (dict.fromkeys([f"j{k}" for k in range(1, 8)], 0.08), r"0\.0\d+ .* required by these masses: currents in ampere\?"),
    *(({f"j{k}": 0.08}, rf"joint {k} reads 0\.0\d+ .* these masses require: currents in ampere") for k in (1, 4, 7)),
    *(({f"j{k}": -1.0}, rf"joint {k}: the torque sign is probably reversed") for k in (1, 4, 7)),
    (dict.fromkeys([f"j{k}" for k in range(1, 8)], 0.01), "possibly motor torques, gear ratio 100"),
    ({"j2": -1.0, "j5": -1.0}, "joints 2, 5: the torque sign is probably reversed"),
])  # fmt: skip
def test_torques_that_cannot_be_are_refused_by_joint(massive, excited, factors: dict[str, float], words: str) -> None:
    table = scaled(excited, **factors)
    with pytest.raises(ShapeError, match=rf"joint-side torques.*{words}.*--force"):
        doubts(table, massive)
    assert any(words.split(" ")[0].split("\\")[0] in said for said in doubts(table, massive, force=True))


@pytest.mark.parametrize("joint", [1, 2, 3, 4, 5, 6, 7])
def test_half_a_torque_is_doubted_by_joint(massive, excited, joint: int) -> None:
    """With masses that are right within a fifth; the message gives the ratio unless it is a half."""
    (said,) = doubts(scaled(excited, **{f"j{joint}": 0.5}), massive)
    assert said.startswith((f"joint {joint} reads half", f"joint {joint} reads 0.4"))


@pytest.mark.slow  # 5 s
@pytest.mark.parametrize(("factor", "words"), [(0.5, "joint 4 reads half"), (0.08, "joint 4 reads 0.08"), (0.9, "")])
def test_joints_without_masses_are_compared_with_each_other(truth, excited, factor: float, words: str) -> None:
    """The joints carry the same links; a gain far from its prior is fitted again without the prior."""
    data = prepare(scaled(excited, j4=factor), truth.robot)
    design = calibrated(Design.build(data, truth.robot, base_parameters(truth.robot)), "irls")[0]
    found = check_gains(design, "irls", force=True)
    assert found == () if not words else found[0].startswith(words) and len(found) == 1
    if factor < 1.0 / 3.0:
        with pytest.raises(ShapeError, match=f"{words}.* that the other joints imply: currents in ampere"):
            check_gains(design, "irls", force=False)


def test_a_forced_fit_carries_its_doubts(short_arm) -> None:
    table = scaled(short_arm.log(0, 1500), j2=-1.0)
    with pytest.raises(ShapeError, match="joint 2: the torque sign is probably reversed"):
        fit_dynamics(table, short_arm.robot)
    fit = fit_dynamics(table, short_arm.robot, force=True)
    assert fit.doubts[0].startswith("joint 2: the torque sign is probably reversed")


# Presliding, position, joints at rest.


def test_presliding_is_judged_without_the_torque_covariance_of_the_model(truth, excited, model) -> None:
    """A large residual, such as from friction over position, does not change where joints are found to slide."""
    data, rows = prepare(excited, truth.robot), np.ones(len(excited), dtype=bool)
    wide = replace(model, covariance=replace(model.covariance, alpha2=1e6 * model.covariance.alpha2))
    smooth = replace(model, friction=replace(model.friction, **dict.fromkeys(
        ("coulomb_pos", "coulomb_neg", "stribeck"), np.zeros(7))))  # fmt: skip
    moving = held_out([(model, rows)], data)[1]
    np.testing.assert_array_equal(held_out([(wide, rows)], data)[1], moving)
    assert held_out([(smooth, rows)], data)[1].all(), "without friction nothing is unknown"


@pytest.mark.parametrize("share", [0.2, 0.4, 0.8])
def test_friction_over_position_is_identified(short_arm, share: float) -> None:
    """A share of the Coulomb friction of joint 1: the residual falls to at most 1.3 times the torque noise."""
    table = short_arm.log(0, 3000)
    z = presliding(table["q"], DELTA, np.zeros(2))
    tau = table["tau"] + np.array([2.0, 0.0]) * share * np.sin(2.5 * table["q"]) * z
    table = table.with_column("tau", tau)
    fit = fit_dynamics(table, short_arm.robot)
    found = fit_friction(table, fit.value)
    assert np.all(np.std(found.residuals, axis=0) < 1.3 * NOISE)
    assert found.value.friction_map is not None
    assert np.all(found.value.friction_map.coefficients[1] == 0)
    np.testing.assert_allclose(found.value.quality.coverage, 0.954, atol=0.03)


def of_rest(fit: Fit[TorqueModel], joint: int) -> tuple[np.ndarray, ...]:
    m = fit.value
    return tuple(
        np.asarray(values)[joint]
        for values in (*vars(m.friction).values(), *vars(m.quality).values(), *vars(m.bound).values(), m.training.q_min)
        if np.ndim(values)
    )


def test_joints_that_rest_are_held_by_the_prior_and_named(short_arm, short_fit) -> None:
    """Friction, quality figures and ranges of joint 2 come from the prior; the fit lists its parameters from there."""
    table = short_arm.log(5, 2000, still={1: 0.3})
    fit = fit_dynamics(table, short_arm.robot, prior=short_fit)
    assert "at rest, with friction from the prior: joint 2" in fit.report()
    np.testing.assert_array_equal(of_rest(fit, 1), of_rest(short_fit, 1))
    scale = fit.value.covariance.alpha2, short_fit.value.covariance.alpha2
    assert scale[0] * fit.value.covariance.C0[1] == pytest.approx(scale[1] * short_fit.value.covariance.C0[1])
    named = dict(zip(fit.names, zip(fit.parameters, fit.sd)))
    for name, value, sd in zip(short_fit.names, short_fit.parameters, short_fit.sd):
        if name.endswith("joint_2") and not name.startswith("rotor"):
            assert named[name] == (value, pytest.approx(sd))
    assert fit.value.friction.coulomb_pos[0] == pytest.approx(2.0, rel=0.1)
    assert 0.9 < fit.value.quality.coverage[0] < 1.0
    assert np.linalg.eigvalsh(fit.cov).min() > -1e-9


def test_parts_of_the_drives_are_fitted_to_the_joints_that_move(short_arm, short_fit) -> None:
    table = short_arm.log(5, 2000, still={1: 0.3})
    z = presliding(table["q"], DELTA, np.zeros(2))
    table = table.with_column("tau", table["tau"] + np.array([0.8, 0.0]) * np.sin(2.5 * table["q"]) * z)
    found = fit_friction(table, short_fit.value)
    assert found.value.friction_map is not None
    assert np.any(found.value.friction_map.coefficients[0] != 0)
    np.testing.assert_array_equal(of_rest(found, 1), of_rest(short_fit, 1))
    assert np.std(found.residuals[:, 0]) < 1.3 * NOISE[0]
    assert prepare_share(table, short_arm.robot).segments == ((0, 2000),)
