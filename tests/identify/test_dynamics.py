"""Fits of the torque model: whole, gravity alone, from sums of many logs, on one thread."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg  # noqa: F401  its BLAS is one of those that count
from threadpoolctl import threadpool_info, threadpool_limits

from armlab import identify, models, robots
from armlab.contact import Estimator
from armlab.errors import ModelMismatchError, NotExcited, ShapeError, UnknownName
from armlab.estimation import ContractLimits, check_estimator
from armlab.estimation.contract import PROPERTIES
from armlab.identify import fit_dynamics, fit_gravity
from armlab.identify.many import fit_draft, log_sums
from armlab.identify.record import prepare_share
from armlab.identify.regression import Design
from armlab.identify.validation import assess
from armlab.kernels import presliding
from armlab.log import Table
from armlab.robots import Robot


def test_fit_dynamics_predicts_the_torque_of_another_motion(truth, model) -> None:
    """On held-out motion, a model fitted without the truth has an error below a tenth of the Coulomb torque."""
    t = np.arange(0, 10, 0.004)
    motion = identify.design_excitation(truth.robot, seconds=10, f0=0.07, harmonics=6, speed=0.4, seed=99)
    clean = truth.log(motion, noise=0.0)
    _, _, qdd = motion.sample(t)
    error = model.torque(clean["q"], clean["qd"], qdd) - clean["tau"]
    assert np.all(np.sqrt(np.mean(error[250:] ** 2, axis=0)) < 0.1 * truth.friction.coulomb_pos)


@pytest.mark.slow  # 50 s beside other work
@pytest.mark.parametrize(("fit", "slow", "runs", "limits"), [
    (fit_dynamics, False, 24, ContractLimits(consistent=(0.45, 0.55), honest=(0.80, 1.25))),
    (fit_gravity, True, 16, None),
])  # fmt: skip
def test_errors_halve_with_four_times_the_data_and_match_the_covariance(short_arm, fit, slow, runs, limits) -> None:
    """The statistical contract on a short arm whose friction structure is unknown; the covariance includes this.

    A common gain is not identifiable from a log of any length: errors halve without gain errors; with them, the
    covariance is judged.
    """
    for law, gain_sd in (("consistent", 0.0), ("honest", 0.05)):
        found = check_estimator(
            lambda table, robot: short_arm.of_base(fit(table, robot)),
            short_arm.experiment(slow=slow, gain_sd=gain_sd),
            runs=runs,
            n=3000,
            noise_given=False,
            limits=limits,
            skip=dict.fromkeys(set(PROPERTIES) - {law}, "tested elsewhere"),
        )
        assert found.passed, found.text()


@pytest.mark.slow  # 15 s beside other work
def test_the_covariance_holds_for_coloured_residuals_and_the_formal_one_does_not(short_arm) -> None:
    """AR(1) noise with a correlation time of 0.2 s: NEES from 0.7 to 1.4, but above 3 with the formal covariance."""
    truth, found = short_arm.experiment()(0, 3000).truth, []
    for k in range(24):
        fit = fit_dynamics(short_arm.log(k, 3000, rho=0.95), short_arm.robot)
        p, formal = len(truth), fit.formal_cov
        assert formal is not None
        e = fit.parameters[:p] - truth
        found.append([e @ np.linalg.solve(C[:p, :p], e) / p for C in (fit.cov, formal)])
    drawn, formal = np.mean(found, axis=0)
    assert 0.7 < drawn < 1.4
    assert formal > 3.0


def test_drift_along_the_log_is_in_the_covariance_of_friction(short_arm, short_fit) -> None:
    """Offsets that change by 20 % of Coulomb friction between the halves of the log."""
    log = short_arm.log(0, 3000)
    drift = np.linspace(-1.0, 1.0, len(log))[:, None] * np.array([0.4, 0.2])
    fit = fit_dynamics(log.with_column("tau", log["tau"] + drift), short_arm.robot)
    p = len(fit.value.base_names)
    for joint, change in zip(short_arm.robot.joint_names, (0.4, 0.2)):
        k = fit.names.index(f"offset {joint}")
        assert 0.5 * change < fit.sd[k] < 2.0 * change
        assert fit.sd[k] > 1.5 * short_fit.sd[short_fit.names.index(f"offset {joint}")]
    error = fit.parameters[:p] - short_arm.experiment()(0, 3000).truth
    assert error @ np.linalg.solve(fit.cov[:p, :p], error) / p < 2.0


@pytest.mark.slow  # 3 min each beside other work
@pytest.mark.filterwarnings("ignore:Expected torque ripple")
@pytest.mark.parametrize("drift", [0.0, 1.0], ids=["steady", "warming and drift"])
def test_halves_of_a_log_agree_within_their_covariances(truth, fitted, drift) -> None:
    """NEES of the difference between 30 s halves, per dimension; for friction it was 15 before drift was included.

    Viscous friction falls by up to 15 % and Coulomb friction by 5 % along the log; offsets and both kinds of friction
    also follow random walks. Both halves share the same gains, which cannot differ, so here they are known.
    """
    model = fitted.value
    known = replace(fitted, value=replace(model, gains=np.ones(7), gain_cov=np.zeros((7, 7))))
    rigid, friction = [], []
    for seed in range(4):
        log = truth.log(identify.design_excitation(truth.robot, seconds=60, seed=1000 + seed), seed=seed)
        log = log.with_column("tau", log["tau"] + drift * _drift(truth, log, seed))
        one, other = (fit_dynamics(log.between(a, a + 29.99), truth.robot, prior=known) for a in (0.0, 30.0))
        names = set(one.names) & set(other.names)
        for found, kinds in ((rigid, model.base_names), (friction, ("viscous", "coulomb", "offset", "stribeck"))):
            some = [name for name in one.names if name in names and name.startswith(tuple(kinds))]
            i, j = ([fit.names.index(name) for name in some] for fit in (one, other))
            e = one.parameters[i] - other.parameters[j]
            found.append(e @ np.linalg.solve(one.cov[np.ix_(i, i)] + other.cov[np.ix_(j, j)], e) / len(e))
    print(f"NEES/n, drift {drift}: rigid {np.mean(rigid):.2f}, friction {np.mean(friction):.2f}")
    assert (0.6 if drift else 0.7) < np.mean(rigid) < 1.4  # a random walk partly looks like noise: 0.64, conservative
    assert 0.7 < np.mean(friction) < 1.4


def _drift(truth, log: Table, seed: int) -> np.ndarray:
    """Return the torque (N, 7) of friction warm-up and of random walks in offsets and friction."""
    rng, n, t, f = np.random.default_rng([seed, 77]), 7, log.t[:, None], truth.friction
    warm = rng.uniform(0.5, 1.5, n) * (np.exp(-t / 60.0) - 1.0)
    walks = np.cumsum(rng.standard_normal((3, len(log), n)), axis=1) * np.sqrt((log.t[1] - log.t[0]) / 30.0)
    viscous, coulomb = 0.25 * warm + 0.05 * walks[0], 0.08 * warm + 0.03 * walks[1]
    z = presliding(log["q"], f.delta, f.resolution)
    return viscous * f.viscous * log["qd"] + f.coulomb_pos * (coulomb * z + 0.06 * walks[2])


def test_the_numbers_of_the_shape_are_parameters_with_deviations(short_arm, short_fit) -> None:
    fit = short_fit
    for i, joint in enumerate(short_arm.robot.joint_names):
        k = fit.names.index(f"delta {joint}")
        assert fit.parameters[k] == fit.value.friction.delta[i]
        assert abs(fit.parameters[k] - 1e-3) < 3.0 * fit.sd[k] < 3e-4
        assert fit.units[k] == "rad"


def _error(short_arm, method: str, **bad) -> float:
    truth = short_arm.experiment()(0, 3000).truth
    fits = (fit_dynamics(short_arm.log(k, 3000, **bad), short_arm.robot, method=method) for k in range(6))
    relative = [(short_arm.of_base(fit).parameters - truth) / np.sqrt(np.abs(truth) + 0.1) for fit in fits]
    return float(np.sqrt(np.mean(np.square(relative))))


@pytest.mark.slow  # 25 s beside other work
def test_outliers_do_little_harm_to_the_robust_methods_only(short_arm) -> None:
    """Five per cent of individual samples are off by ten standard deviations."""
    for method in ("irls", "lts"):
        assert _error(short_arm, method, bad=0.05) < 1.3 * _error(short_arm, method)
    assert _error(short_arm, "ols", bad=0.05) > 2.0 * _error(short_arm, "ols")


@pytest.mark.slow  # 10 s beside other work
def test_stretches_of_outliers_do_little_harm_to_trimming(short_arm) -> None:
    """Segments of half a second, five per cent of the log."""
    assert _error(short_arm, "lts", bad=0.05, stretch=50) < 1.3 * _error(short_arm, "lts")


SKIPPED = {
    "consistent": "tested above on a short arm",
    "honest": "tested above on a short arm",
    "efficient": "residuals of robots are coloured: there is no bound to reach",
    "order-free": "friction remembers: the rows of a log have an order",
    "gauge-free": "parameters are those of the robot's own frames",
    "robust": "Huber's loss and trimming have tests of their own in estimation",
}


@pytest.mark.slow  # 5 s
@pytest.mark.parametrize("fit", [fit_dynamics, fit_gravity])
def test_the_laws_of_the_statistical_contract(fit, short_arm) -> None:
    """Bit-identical files and repeats, unchanged inputs, read-only outputs, and NaN refused with its row."""
    robot, experiment = short_arm.robot, short_arm.experiment(slow=fit is fit_gravity)
    log = experiment(0, 3000).data["table"]
    locked = np.arange(2) == 1
    still = log.with_column("q", np.where(locked, 0.3, log["q"])).with_column("qd", np.where(locked, 0.0, log["qd"]))
    contract = check_estimator(
        fit, experiment, 1, n=3000, refusals={robot.joint_names[1]: {"table": still, "robot": robot}}, skip=SKIPPED
    )
    assert contract.passed, contract.text()


def test_the_fit_reports_every_joint(truth, fitted) -> None:
    fit = fitted
    assert 50 + 7 * 6 <= len(fit.names) == len(fit.parameters) <= 50 + 7 * 10
    assert fit.names[:50] == fit.value.base_names
    assert fit.excitation.condition < 300
    text = fit.report()
    assert text.count("+-") == len(fit.names) + 4 * truth.robot.n  # friction in three columns, and the gain
    assert "good" in text
    assert np.all(fit.value.quality.rms_cv < 0.05 * fit.value.quality.torque_sd)
    np.testing.assert_allclose(fit.value.quality.coverage, 0.954, atol=0.03)


def test_the_model_keeps_the_covariance_of_all_parameters(short_fit, tmp_path) -> None:
    """Covariance of the fit and of friction drift until the next log; another arm's parameters are refused."""
    model = short_fit.value
    known, size = model.parameters, len(model.base_names)
    np.testing.assert_allclose(known.cov[:size, :size], model.base_cov, rtol=1e-9, atol=1e-30)
    at = 11 * model.n + 7 * np.arange(model.n)
    viscous = np.diag(known.cov)[np.searchsorted(known.columns, at)]
    assert np.all(viscous > 0)
    saved = models.load(models.save(model, tmp_path / "model.toml"))
    np.testing.assert_array_equal(saved.parameters.cov, known.cov)
    with pytest.raises(ShapeError, match="parameter columns that belong to"):
        replace(model, parameters=replace(known, columns=known.columns + 18 * model.n))
    with pytest.raises(ShapeError, match="finite numbers of their covariance"):
        replace(known, lower=known.lower[1:])
    with pytest.raises(ShapeError, match="torque variances"):
        replace(known, mean=-known.mean)


def test_held_out_rows_of_several_logs_are_held_out(short_arm, monkeypatch) -> None:
    """Two logs with restarting clocks, the second shorter: each row is held out once, by a model without its block."""
    seen = {}

    def spy(model, folds, data, *_, **__):
        seen.update(folds=folds, data=data)
        return assess(model, folds, data)

    monkeypatch.setattr("armlab.identify.dynamics.assess", spy)
    fit = fit_dynamics([short_arm.log(0, 1600), short_arm.log(1, 1200)], short_arm.robot, method="wls")
    masks = np.array([rows for _, rows in seen["folds"]])
    np.testing.assert_array_equal(masks.sum(axis=0), 1)
    for a, b in seen["data"].segments:
        assert np.all(masks[:, a:b].mean(axis=1) > 0.05)
    assert fit.value.quality.seconds == pytest.approx(15.99 + 11.99)  # the gap between the logs does not count
    assert np.all(fit.value.quality.rms_cv > fit.value.quality.rms)


def test_same_log_same_bits_and_progress_changes_nothing(short_arm, short_fit) -> None:
    said: list[str] = []
    one, again = (
        short_fit,
        fit_dynamics(short_arm.log(0, 3000), short_arm.robot, progress=lambda done, total, what: said.append(what)),
    )
    assert said[0] == "checking the log"
    assert said[-1] == "done"
    assert np.array_equal(again.parameters, one.parameters)
    assert np.array_equal(again.cov, one.cov)
    assert again.report() == one.report()


def test_a_small_sway_of_all_joints_is_refused_by_direction(short_arm) -> None:
    robot, t = short_arm.robot, np.arange(0, 6, 0.01)
    q, qd, qdd = (0.1 * wave[:, None] * np.ones(2) for wave in (np.sin(2 * t), 2 * np.cos(2 * t), -4 * np.sin(2 * t)))
    links = np.tile([1.5, 0.25, 0.05, 0.02, 0.05, 0.01, 0.2, 0, 0.01, 0.22], (2, 1))
    table = Table(t, {"q": q, "qd": qd, "tau": robot.chain.rnea(q, qd, qdd, robot.gravity, links) + np.sign(qd)})
    with pytest.raises(NotExcited, match="does not determine") as caught:
        fit_dynamics(table, robot, method="wls")
    assert any("m c" in direction or "I_" in direction for direction in caught.value.directions)


@pytest.mark.slow  # 5 s beside other work
def test_a_prior_holds_what_a_small_sway_does_not_tell_and_is_of_this_robot(truth, fitted) -> None:
    robot = truth.robot
    t = np.arange(0, 6, 0.01)
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


@pytest.mark.slow  # 5 s beside other work
def test_joints_without_torque_are_left_out_of_the_model(truth, excited) -> None:
    """Two wrist joints send no torque. The results of the others do not change, and no estimator uses these two."""
    robot, measured = truth.robot, [0, 1, 2, 3, 4]
    silent = excited["tau"] * np.isin(np.arange(7), measured)
    fit = fit_dynamics(excited.with_column("tau", silent), robot, joints=measured, method="wls")
    quality, friction = fit.value.quality, fit.value.friction
    assert np.isnan(quality.rms_cv[5:]).all()
    assert np.all(quality.rms_cv[:5] < 0.05 * quality.torque_sd[:5])
    np.testing.assert_allclose(friction.coulomb_pos[:5], truth.friction.coulomb_pos[:5], rtol=0.1)
    assert fit.value.covariance.C0[5:].min() > 1e10
    assert fit.value.momentum is None
    table = fit.report().split("\n\n")[1].splitlines()
    assert [line.split()[0] for line in table[2:7]] == ["1", "2", "3", "4", "5"]
    assert not any(name.endswith(("axis_5", "axis_6")) for name in fit.names)
    for wrong in ([], [7], [1, 1]):
        with pytest.raises(UnknownName, match="joint numbers from 0 to 6"):
            fit_dynamics(excited, robot, joints=wrong)


# Gravity, friction and offsets from slow motion.


def test_gravity_of_other_poses_is_predicted(truth, gravity) -> None:
    """Gravity torque as measured is predicted to 4 % of its standard deviation over random poses in the range of the
    log (3 % if all gains were known), and offsets up to friction asymmetry."""
    model, robot = gravity.value, truth.robot
    rng = np.random.default_rng(0)
    q = rng.uniform(model.training.q_min, model.training.q_max, (500, 7))
    still = np.zeros_like(q)
    expected = robot.chain.rnea(q, still, still, robot.gravity, truth.links)
    found = model.gains * model.rigid_torque(q, still, still)
    heavy = np.std(expected, axis=0) > 0.1
    assert heavy.sum() >= 4
    assert np.all((np.std(found - expected, axis=0) / np.std(expected, axis=0))[heavy] < 0.04)
    offset = np.mean(found - expected, axis=0) + model.friction.offset - truth.friction.offset
    assert np.all(np.abs(offset) < 0.08 * truth.friction.coulomb_pos)


def test_the_model_has_no_torque_of_motion(truth, gravity) -> None:
    model = gravity.value
    assert model.quasi_static
    assert len(model.base_names) == 14
    assert not model.rotor.any()
    rng = np.random.default_rng(1)
    q, qd, qdd = rng.uniform(-1, 1, (3, 50, 7))
    still = np.zeros_like(q)
    moving = model.rigid_torque(q, 3 * qd, 10 * qdd)
    np.testing.assert_allclose(moving, model.rigid_torque(q, still, still), atol=1e-6)
    with_gravity = truth.robot.chain.rnea(q, still, still, model.gravity, model.link_parameters)
    np.testing.assert_allclose(model.rigid_torque(q, still, still), with_gravity, atol=1e-12)


def test_it_is_saved_and_estimates(truth, gravity, slow, tmp_path) -> None:
    again = models.load(models.save(gravity.value, tmp_path / "gravity.toml"))
    assert again.quasi_static
    estimate = Estimator(again, truth.robot).run(slow)
    force = estimate["wrench_hat"][500:, :3]
    assert np.all(np.sqrt(np.mean(force**2, axis=0)) < 2.0), "free motion: no force"


# Sums of many logs.


def test_sums_are_known_by_all_that_they_depend_on(short_arm) -> None:
    """The sums of a log are cached by the pattern's hash; without a new hash, another pattern's would be used."""
    _, pattern = fit_draft([short_arm.log(0, 1500)], short_arm.robot, 1)
    assert pickle.loads(pickle.dumps(pattern)).sha256 == pattern.sha256
    others = [
        replace(pattern, limit=2 * pattern.limit),
        replace(pattern, theta=pattern.theta + 1e-12),
        replace(pattern, blocks=pattern.blocks + 1),
        replace(pattern, rate=99.0),
        replace(pattern, lines=np.full(2, 99.0)),
        replace(pattern, robot=robots.load("ur5e")),
    ]
    assert len({one.sha256 for one in (pattern, *others)}) == 7


def test_the_draft_decides_on_ripple_for_every_log(short_arm) -> None:
    """A log on its own would have different columns, and its sums could not be added to those of the others."""
    robot = replace(short_arm.robot, coupling=np.eye(2) / 60.0)
    slow = short_arm.log(0, 1500)
    fast = Table(slow.t, {"q": 6.0 * slow["q"], "qd": 6.0 * slow["qd"], "tau": slow["tau"]})
    _, pattern = fit_draft([slow], robot, 4)
    assert len(pattern.lines)
    data = prepare_share(fast, robot)
    with pytest.warns(UserWarning, match="no ripple is fitted"):
        assert not Design.build(data, robot, pattern.base).geared
    assert pattern.design(data).geared
    one, other = (log_sums(table, pattern).factors for table in (slow, fast))
    assert [R.shape for R in one.R] == [R.shape for R in other.R]


# BLAS threads.


def threads() -> dict[str, int]:
    """Threads of each BLAS that is loaded; one that was built for a single thread always has one."""
    return {pool["filepath"]: pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


class Stopped(Exception):
    """Stops a fit that has shown what the test needs."""


def test_a_fit_has_one_thread(excited: Table, truth) -> None:
    robot: Robot = truth.robot
    seen: list[dict[str, int]] = []

    def look(done: int, total: int, what: str) -> None:
        seen.append(threads())
        raise Stopped

    with threadpool_limits(2, "blas"):
        before = threads()
        with pytest.raises(Stopped):
            identify.fit_dynamics(excited, robot, progress=look)
        assert [set(one.values()) for one in seen] == [{1}]
        assert threads() == before
