"""The torque model: right, honest about its uncertainty, and refused when the log cannot tell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab import identify, robots
from armlab.errors import ModelMismatchError, NotExcited, UnknownName
from armlab.estimation import Experiment, check_estimator
from armlab.identify import base_parameters, fit_dynamics, fit_gravity, prepare
from armlab.identify.design import Design
from armlab.identify.dynamics import Job, fit_model, settle
from armlab.identify.validation import assess
from armlab.log import Table


def test_fit_dynamics_predicts_the_torque_of_another_motion(truth, model) -> None:
    """Held-out motion: the error stays below a tenth of the Coulomb torque, without any knowledge of the truth."""
    t = np.arange(0, 20, 0.004)
    motion = identify.excitation(truth.robot, seconds=20, f0=0.07, harmonics=6, speed=0.4, seed=99)
    clean = truth.log(motion, noise=0.0)
    _, _, qdd = motion.sample(t)
    error = model.torque(clean["q"], clean["qd"], qdd) - clean["tau"]
    assert np.all(np.sqrt(np.mean(error[250:] ** 2, axis=0)) < 0.1 * truth.friction.coulomb_pos)


@pytest.mark.slow  # 60 s
def test_errors_match_the_covariance_and_shrink(truth) -> None:
    """All base parameters and viscous friction: NEES near 1 over seeds; four times the data halves the error."""
    base, robot = base_parameters(truth.robot), truth.robot
    expected = dict(zip(base.names, base.B @ np.concatenate([truth.links.ravel(), truth.rotor])))
    expected |= {f"viscous {name}": value for name, value in zip(robot.joint_names, truth.friction.viscous)}
    errors, covariances = {20: [], 80: []}, []
    for seconds, seeds in ((20, 6), (80, 2)):
        for seed in range(seeds):
            motion = identify.excitation(robot, seconds=seconds, seed=seed)
            fit = fit_dynamics(truth.log(motion, seed=seed), robot)
            known = [fit.names.index(name) for name in expected]
            errors[seconds].append(fit.parameters[known] - list(expected.values()))
            covariances.append(fit.cov[np.ix_(known, known)])
    nees = [e @ np.linalg.solve(C, e) / len(e) for e, C in zip([*errors[20], *errors[80]], covariances)]
    assert 0.7 < np.mean(nees) < 1.4
    weight = np.linalg.inv(np.mean(covariances[:6], axis=0))
    power = [np.mean([e @ weight @ e for e in errors[seconds]]) for seconds in (80, 20)]
    assert 0.35 < np.sqrt(power[0] / power[1]) < 0.65


SKIPPED = {
    "consistent": "in the test above, with fewer runs",
    "honest": "in the test above, with fewer runs",
    "efficient": "residuals of robots are coloured: there is no bound to reach",
    "order-free": "friction remembers: the rows of a log have an order",
    "gauge-free": "parameters are those of the robot's own frames",
    "robust": "Huber's loss and trimming have tests of their own in estimation",
    "explains": "the report is a table per joint; the table of the fit has every value",
}


@pytest.mark.slow  # 15 s
@pytest.mark.parametrize("fit", [fit_dynamics, fit_gravity])
def test_the_laws_of_the_statistical_contract(fit, truth) -> None:
    """Files bit-equal, inputs as they were, outputs read-only, the same bits twice, NaN refused by its row."""
    robot = truth.robot
    fast = {} if fit is fit_dynamics else {"f0": 1 / 60, "harmonics": 3, "speed": 0.07}
    motion = identify.excitation(robot, seconds=12 if fit is fit_dynamics else 40, seed=3, **fast)
    log = truth.log(motion, seed=0)
    locked = np.arange(7) == 3
    still = log.with_column("q", np.where(locked, 0.3, log["q"])).with_column("qd", np.where(locked, 0.0, log["qd"]))
    contract = check_estimator(
        fit,
        lambda seed, n: Experiment({"table": truth.log(motion, seed=seed), "robot": robot}, None),
        1,
        n=len(log),
        refusals={robot.joint_names[3]: {"table": still, "robot": robot}},
        skip=SKIPPED,
    )
    assert contract.passed, contract.text()


def test_the_table_of_a_fit_has_every_value_with_unit_and_deviation(fitted) -> None:
    lines = fitted.table().splitlines()
    for name, unit, line in zip(fitted.names, fitted.units, lines):
        assert line.startswith(name)
        assert line.endswith(unit)
        assert " +- " in line


def test_the_fit_reports_every_joint_and_progress(truth, excited) -> None:
    said: list[str] = []
    fit = fit_dynamics(excited, truth.robot, progress=lambda done, total, what: said.append(what))
    assert said[0] == "checking the log"
    assert said[-1] == "done"
    assert 50 + 7 * 6 <= len(fit.names) == len(fit.parameters) <= 50 + 7 * 8
    assert fit.names[:50] == fit.value.base_names
    assert fit.excitation.condition < 300
    text = fit.report()
    assert text.count("+-") == 3 * truth.robot.n
    assert "good" in text
    assert np.all(fit.value.quality.rms_cv < 0.05 * fit.value.quality.torque_sd)
    np.testing.assert_allclose(fit.value.quality.coverage, 0.954, atol=0.03)


def test_held_out_rows_of_several_logs_are_held_out(truth, excited, monkeypatch) -> None:
    """Clocks that start again, the second log shorter: each row is held out once, by a model without its block."""
    seen = {}

    def spy(model, folds, data, joints):
        seen.update(folds=folds, data=data)
        return assess(model, folds, data)

    monkeypatch.setattr("armlab.identify.dynamics.assess", spy)
    other = truth.log(identify.excitation(truth.robot, seconds=12, seed=5), seed=5)
    fit = fit_dynamics([excited.between(10.0, 30.0), other], truth.robot)
    masks = np.array([rows for _, rows in seen["folds"]])
    np.testing.assert_array_equal(masks.sum(axis=0), 1)
    for a, b in seen["data"].segments:
        assert np.all(masks[:, a:b].mean(axis=1) > 0.05)
    assert fit.value.quality.seconds == pytest.approx(32.0, abs=0.02)
    assert np.all(fit.value.quality.rms_cv > fit.value.quality.rms)


def test_a_model_without_known_gears_is_identified(truth, excited) -> None:
    robot = replace(truth.robot, coupling=np.eye(7))
    fit = fit_dynamics(excited, robot)
    assert not any("ripple" in name for name in fit.names)
    assert not fit.value.ripple.cosine.any()
    assert "held-out" in fit.report()


def test_same_log_same_bits(truth, excited, model) -> None:
    again = fit_dynamics(excited, truth.robot).value
    assert np.array_equal(again.base_values, model.base_values)
    assert np.array_equal(again.base_cov, model.base_cov)


def test_a_log_of_one_joint_is_refused_by_the_names_of_the_others(truth) -> None:
    t = np.arange(0, 20, 0.004)
    robot = truth.robot
    q = np.tile(robot.q_home, (len(t), 1))
    q[:, 2] += 0.5 * np.sin(t)
    qd = np.zeros_like(q)
    qd[:, 2] = 0.5 * np.cos(t)
    tau = np.random.default_rng(0).standard_normal(q.shape)
    with pytest.raises(NotExcited) as caught:
        fit_dynamics(Table(t, {"q": q, "qd": qd, "tau": tau}), robot)
    assert set(caught.value.directions) == set(robot.joint_names) - {robot.joint_names[2]}


def test_a_small_sway_of_all_joints_is_refused_by_direction(truth) -> None:
    """All joints in phase over 0.1 rad: acceleration is proportional to position, so gravity and inertia look alike."""
    robot = truth.robot
    t = np.arange(0, 20, 0.004)
    wave = np.stack([np.sin(2 * t), 2 * np.cos(2 * t), -4 * np.sin(2 * t)])[:, :, None] * 0.1 * np.ones(robot.n)
    q, qd, qdd = robot.q_home + wave[0], wave[1], wave[2]
    table = Table(t, {"q": q, "qd": qd, "tau": truth.torque(q, qd, qdd, np.sign(qd))})
    with pytest.raises(NotExcited, match="does not tell apart") as caught:
        fit_dynamics(table, robot)
    assert any("m c" in direction or "I_" in direction for direction in caught.value.directions)


def test_a_prior_holds_what_a_small_sway_does_not_tell_and_is_of_this_robot(truth, fitted) -> None:
    robot = truth.robot
    t = np.arange(0, 10, 0.004)
    wave = np.stack([np.sin(2 * t), 2 * np.cos(2 * t), -4 * np.sin(2 * t)])[:, :, None] * 0.1 * np.ones(robot.n)
    q, qd, qdd = robot.q_home + wave[0], wave[1], wave[2]
    noise = truth.noise * np.random.default_rng(0).standard_normal(q.shape)
    table = Table(t, {"q": q, "qd": qd, "tau": truth.torque(q, qd, qdd, np.sign(qd)) + noise})
    fit = fit_dynamics(table, robot, method="wls", prior=fitted)
    assert fit.excitation.rank < fit.excitation.expected
    assert len(fit.excitation.held) == fit.excitation.expected - fit.excitation.rank
    assert "held by the prior: " in fit.report()
    with pytest.raises(ModelMismatchError, match=r"'yumi_left'.*got 'yumi_right'"):
        fit_dynamics(table, robots.load("yumi_right"), method="wls", prior=fitted)


def test_settle_uses_the_rows_it_is_told_and_spares_outliers(truth, excited) -> None:
    """Half of the blocks spoilt: used, they ruin the fit; left out, the other half gives it."""
    robot = truth.robot
    data = prepare(excited, robot)
    half = data.blocks(1.0) % 2 == 1
    spoilt = replace(data, tau=data.tau + np.where(half[:, None], 5.0, 0.0))
    design = Design.build(spoilt, robot, base_parameters(robot))
    use = ~half[design.rows]
    use = np.all([np.roll(use, k) for k in range(-16, 17)], axis=0)  # the filter carries steps over the edge of a block
    found, theta = settle(design, "wls", use=use)
    error = found.residuals(theta)[use]
    assert np.all(np.std(error, axis=0) < 0.05 * np.std(data.tau, axis=0))


def test_an_unknown_method_is_refused_before_the_log_is_read(truth) -> None:
    job = Job("torque model", "median", 0, lambda done, total, what: None)
    with pytest.raises(UnknownName, match="method of identification"):
        fit_model([], truth.robot, base_parameters(truth.robot), job)


def test_joints_without_torque_are_left_out_of_the_model(truth, excited) -> None:
    """Two wrist joints send nothing. The others come out as before, and no estimator listens to the two."""
    robot, measured = truth.robot, [0, 1, 2, 3, 4]
    silent = excited["tau"] * np.isin(np.arange(7), measured)
    fit = fit_dynamics(excited.with_column("tau", silent), robot, joints=measured)
    quality, friction = fit.value.quality, fit.value.friction
    assert np.isnan(quality.rms_cv[5:]).all()
    assert np.all(quality.rms_cv[:5] < 0.05 * quality.torque_sd[:5])
    np.testing.assert_allclose(friction.coulomb_pos[:5], truth.friction.coulomb_pos[:5], rtol=0.1)
    assert fit.value.covariance.C0[5:].min() > 1e10
    assert fit.value.momentum is None
    table = fit.report().splitlines()
    assert [line.split()[0] for line in table[2:7]] == ["1", "2", "3", "4", "5"]
    assert not any(name.endswith(("axis_5", "axis_6")) for name in fit.names)
    for wrong in ([], [7], [1, 1]):
        with pytest.raises(UnknownName, match="numbers of joints from 0 to 6, each once"):
            fit_dynamics(excited, robot, joints=wrong)
