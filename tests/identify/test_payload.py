"""Payload identification, errors of the arm model, and physical consistency of loads and links."""

from __future__ import annotations

import re
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest

from armlab import dynamics, identify, robots, sim
from armlab.errors import ConfigError, NotExcited, ShapeError
from armlab.estimation import Experiment, Fit, check_estimator
from armlab.identify import fit_payload, physically_consistent, physically_consistent_load
from armlab.identify.consistency import LEAST, PhysicallyConsistent, pseudo_inertia
from armlab.identify.payload import LoadRecord, ModelError
from armlab.identify.residuals import model_residuals
from armlab.kernels import presliding
from armlab.log import Table
from armlab.robots import Robot, from_links, inertia

MASS, CENTRE = 0.5, np.array([0.03, 0.0, 0.052])  # 60 mm from the flange
POINT = inertia.from_body(MASS, CENTRE, np.zeros((3, 3)))


def carrying(truth, pi: np.ndarray):
    links = truth.links.copy()
    links[-1] += inertia.transform(truth.robot.links[-1], pi)
    return replace(truth, links=links)


@pytest.fixture(scope="module")
def motion(truth):
    return identify.design_excitation(truth.robot, seconds=14, speed=0.4, acceleration=8.0, seed=3)


@pytest.fixture(scope="module")
def brief(truth):
    return identify.design_excitation(truth.robot, seconds=12, speed=0.4, seed=3)


@pytest.fixture(scope="module")
def table(truth, motion) -> Table:
    return carrying(truth, POINT).log(motion, seed=3)


@pytest.mark.parametrize("pair", [False, True])
def test_half_a_kilogram(truth, model, motion, table, pair: bool) -> None:
    """With a log without the load, friction errors of the model cancel in the difference."""
    if pair:
        model = replace(model, friction=replace(model.friction, viscous=1.5 * model.friction.viscous))
    fit = fit_payload(table, model, truth.robot, without=truth.log(motion, seed=4) if pair else None)
    assert fit.value.mass == pytest.approx(MASS, rel=0.03)
    np.testing.assert_allclose(fit.value.centre, CENTRE, atol=5e-3)
    assert 0.01 < fit.sd[0] / MASS < 0.05  # what a gain uncertainty of 5 % leaves
    assert np.all(np.abs(fit.parameters - POINT[:4]) < 3 * fit.sd)
    text = fit.report()
    draws = np.random.default_rng(0).multivariate_normal(fit.parameters[:4], fit.cov[:4, :4], 20_000)
    spread = 1e3 * (draws[:, 1:] / draws[:, :1]).std(axis=0)  # mm
    stated = [float(value) for value in re.findall(r"centre [xyz] .* \+- (.*) mm", text)]
    assert stated == pytest.approx(spread, rel=0.1, abs=0.06)
    assert "gains" in text


def test_a_body_with_inertia(truth, model, motion) -> None:
    pi = inertia.from_body(0.5, CENTRE, np.diag([4e-3, 6e-3, 3e-3]))
    clean = truth.log(motion, seed=4)
    fit = fit_payload(carrying(truth, pi).log(motion, seed=3), model, truth.robot, "dynamic", clean)
    assert fit.names[4:] == ("I_xx", "I_xy", "I_yy", "I_xz", "I_yz", "I_zz")
    assert np.all(np.abs(fit.parameters - pi) < 3.5 * fit.sd)
    assert np.all(fit.sd[4:] < 2e-3)
    assert "I_zz" in fit.report()


def test_the_loaded_model_predicts_the_loaded_arm(truth, model, motion, table) -> None:
    loaded = fit_payload(table, model, truth.robot).value.added_to(model)
    left = [np.std(identify.predict(m, table)["tau"] - identify.predict(m, table)["tau_model"], axis=0) for m in
            (model, loaded)]  # fmt: skip
    assert np.all(left[1][:6] < 0.5 * left[0][:6])


def test_known_gains_say_more_and_gains_are_found_where_joints_differ(truth, model, motion, table) -> None:
    sure = fit_payload(table, model, truth.robot, gain_sd=0.0)
    assert sure.sd[0] < 0.5 * fit_payload(table, model, truth.robot).sd[0]
    assert "gains" not in sure.report()
    clean = truth.log(motion, noise=0.0)
    wrong = np.array([1.05, 0.95, 1.05, 0.95, 1.0, 1.0, 1.0])
    heavy = carrying(truth, POINT).log(motion, noise=0.0)
    tau = clean["tau"] + wrong * (heavy["tau"] - clean["tau"])
    found = fit_payload(heavy.with_column("tau", tau), model, truth.robot, without=clean)
    assert abs(found.value.mass - MASS) < 0.02 * MASS
    np.testing.assert_allclose(found.value.centre, CENTRE, atol=1e-3)


def test_a_wrist_alone_weighs_it(truth, model) -> None:
    """Joints at rest are excluded, because their friction is unknown."""
    robot = truth.robot
    t = np.arange(0, 15, 0.004)[:, None]
    moves = np.arange(7) >= 3
    rate = 2 * np.pi * np.array([0.1, 0.1, 0.1, 0.17, 0.23, 0.31, 0.13])
    q = robot.q_home + 0.6 * np.sin(rate * t) * moves
    qd, qdd = 0.6 * rate * np.cos(rate * t) * moves, -0.6 * rate**2 * np.sin(rate * t) * moves
    z = presliding(q, truth.friction.delta, np.zeros(7))
    tau = carrying(truth, POINT).torque(q, qd, qdd, z)
    tau = tau + truth.noise * np.random.default_rng(1).standard_normal(q.shape)
    fit = fit_payload(Table(t[:, 0], {"q": q, "qd": qd, "tau": tau}), model, robot)
    assert fit.residuals.shape[1] == 4
    assert fit.value.mass == pytest.approx(MASS, abs=3 * fit.sd[0])
    assert fit.sd[0] < 0.1 * MASS
    assert f"excluded because at rest: {', '.join(robot.joint_names[:3])}" in fit.report()


def test_a_load_on_another_link_is_doubted(truth, model, motion, table) -> None:
    links = truth.links.copy()
    links[3] += inertia.from_body(1.5, [0.0, 0.0, 0.0], np.zeros((3, 3)))
    (doubt,) = fit_payload(replace(truth, links=links).log(motion, seed=3), model, truth.robot).doubts
    assert "a load elsewhere, or the log may contain a contact" in doubt
    assert fit_payload(table, model, truth.robot).good


def test_no_load_is_no_load(truth, model, motion) -> None:
    fit = fit_payload(truth.log(motion, seed=5), model, truth.robot)
    assert 0 <= fit.value.mass < 0.02
    assert np.linalg.norm(fit.parameters[1:]) <= 0.5 * fit.value.mass


def test_a_load_that_the_log_cannot_weigh_is_refused_by_name(truth, model) -> None:
    with pytest.raises(NotExcited, match="payload") as caught:
        fit_payload(**weightless(truth, model))
    assert any("m" in direction.split() for direction in caught.value.directions)


@pytest.fixture(scope="module")
def experiment(truth, fitted):
    """Free motion at 100 Hz of an arm that the model describes exactly, except for the gains on the load's torque."""
    robot, model = truth.robot, replace(fitted.value, gain_cov=np.zeros((7, 7)))
    known = replace(fitted, value=model, cov=0.0 * fitted.cov)
    motion = identify.design_excitation(robot, seconds=70, speed=0.4, acceleration=8.0, seed=9)

    def make(gain_sd: float, seed: int, n: int) -> Experiment:
        rng = np.random.default_rng([7, seed])
        t = 0.01 * np.arange(1, n + 1)
        q, qd, qdd = motion.sample(t)
        pi = np.zeros((7, 10))
        pi[-1] = inertia.transform(robot.links[-1], POINT)
        gains = model.gains * (1.0 + gain_sd * rng.standard_normal(7))
        tau = model.torque(q, qd, qdd) + gains * robot.chain.rnea(q, qd, qdd, robot.gravity, pi)
        table = Table(t, {"q": q, "qd": qd, "tau": tau + truth.noise * rng.standard_normal(q.shape)})
        return Experiment({"table": table, "model": known, "robot": robot, "gain_sd": gain_sd}, POINT[:4])

    return make


REASONS = {
    "order-free": "friction remembers: the rows of a log have an order",
    "gauge-free": "tested in the frames' own tests; the flange is the only frame here",
    "robust": "the filter spreads a single wrong sample over its neighbours; Huber's loss bounds what is left",
    "efficient": "needs 1000 runs",
}


def weightless(truth, model) -> dict:
    """Without gravity and nearly at rest, the torques contain no information about a mass."""
    robot = replace(truth.robot, gravity=np.zeros(3))
    light = replace(model, gravity=np.zeros(3), robot_hash=robot.hash)
    t = np.arange(0, 20, 0.004)[:, None]
    q, qd = robot.q_home + 0.1 * np.sin(0.2 * t), 0.02 * np.cos(0.2 * t) * np.ones(7)
    tau = light.torque(q, qd) + truth.noise * np.random.default_rng(0).standard_normal(q.shape)
    return {"table": Table(t[:, 0], {"q": q, "qd": qd, "tau": tau}), "model": light, "robot": robot}


@pytest.mark.slow  # 7 s
def test_the_statistical_contract(experiment, truth, model) -> None:
    """With known gains and a perfect model, errors shrink as the record grows."""
    contract = check_estimator(
        fit_payload,
        lambda seed, n: experiment(0.0, seed, n),
        20,
        n=1400,
        refusals={"m": weightless(truth, model)},
        noise_given=False,
        skip=REASONS,
    )
    assert contract.passed, contract.text()


@pytest.mark.slow  # 7 s
def test_gains_are_in_the_covariance(experiment) -> None:
    """Gains of 5 %: NEES stays 1, though errors do not shrink with the record."""
    reasons = {**REASONS, "consistent": "the gains do not average out", "refuses": "see above"}
    contract = check_estimator(
        fit_payload, lambda seed, n: experiment(0.05, seed, n), 20, n=1400, noise_given=False, skip=reasons
    )
    assert contract.passed, contract.text()


def three_joints(seed: tuple[int, int], n: int, motion: int, pi: np.ndarray, noise: float) -> tuple[Table, Robot]:
    """A 100 Hz log of a three-joint arm with Coulomb and viscous friction that carries a load pi."""
    turned, down, flange = np.eye(4), np.eye(4), np.eye(4)
    turned[:3, :3] = down[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    down[0, 3], flange[2, 3] = 0.3, 0.1
    robot = from_links("three", [np.eye(4), turned, down, flange])
    links = np.array(
        [[3, 0.1, 0.02, 0.3, 0.5, 0.01, 0.4, 0.02, 0.01, 0.3], [1.5, 0.25, 0.05, 0.02, 0.05, 0.01, 0.2, 0, 0.01, 0.22],
         [0.8, 0.02, 0.01, 0.08, 0.02, 0, 0.02, 0, 0, 0.01]]
    )  # fmt: skip
    links[-1] += inertia.transform(flange, pi)
    f, draw = np.array([0.11, 0.23, 0.37, 0.61, 0.83])[:, None, None], np.random.default_rng(motion)
    a, phase, w = draw.uniform(0.015, 0.05, (5, 1, 3)) / f, draw.uniform(0, 6, (5, 1, 3)), 2 * np.pi * f
    t = np.arange(n) / 100.0
    wave = w * t[:, None] + phase
    q, qd, qdd = (x.sum(axis=0) for x in (a * np.sin(wave), a * w * np.cos(wave), -a * w**2 * np.sin(wave)))
    tau = robot.chain.rnea(q, qd, qdd, robot.gravity, links) + np.array([0.2, 0.1, 0.05]) * qdd + [0.3, -0.2, 0.1]
    tau += np.array([1.0, 0.5, 0.3]) * qd + np.array([2.0, 1.0, 0.5]) * presliding(q, np.full(3, 1e-3), np.zeros(3))
    tau += noise * np.array([0.3, 0.2, 0.1]) * np.random.default_rng(seed).standard_normal(q.shape)
    return Table(t, {"q": q, "qd": qd, "tau": tau}), robot


@pytest.mark.slow  # 15 s
def test_an_identified_model_is_in_the_covariance() -> None:
    """Each load is identified with a model from a separate log: NEES is at most 1, within three standard errors.

    It is 0.35: the model's covariance includes drift, alternative structures and the gain prior, which these logs lack.
    """
    nees = []
    for seed in range(12):
        clean, robot = three_joints((1, seed), 2000, 1, np.zeros(10), 1.0)
        loaded, _ = three_joints((2, seed), 1500, 2, POINT, 0.3)
        fit = fit_payload(loaded, identify.fit_dynamics(clean, robot), robot, gain_sd=0.0)
        e = fit.parameters - POINT[:4]
        nees.append(e @ np.linalg.solve(fit.cov, e) / 4)
    assert 0.2 < np.mean(nees) < 1.0 + 3.0 * np.sqrt(2.0 / (4 * len(nees)))


def test_of_a_model_without_its_fit_friction_is_said_to_be_unknown(truth, fitted, table) -> None:
    words = "pass the fit instead of the model"
    assert words in fit_payload(table, fitted.value, truth.robot).report()
    assert words not in fit_payload(table, fitted, truth.robot).report()


# Load regression.


PI = inertia.from_body(0.5, [0.03, -0.01, 0.06], np.diag([1e-3, 2e-3, 1.5e-3]))


@pytest.fixture(scope="module")
def loaded(truth):
    return carrying(truth, PI)


@pytest.mark.parametrize("late", [300, -300])
def test_a_log_that_began_at_another_time(truth, model, loaded, brief, late: int) -> None:
    one, two = loaded.log(brief, noise=0.0), truth.log(brief, noise=0.0)
    if late > 0:
        two = two.rows(slice(late, None))
    else:
        one = one.rows(slice(-late, None))
    record = LoadRecord.of(one, model, truth.robot, two)
    np.testing.assert_allclose(record.y[20:-20], (record.A @ PI)[20:-20], atol=0.02)


# Uncertainty of the model of the arm.


def test_what_is_not_known_by_name_is_left_out_and_said(truth, fitted) -> None:
    names = (*fitted.names[:-1], "coulomb of motor of another arm")
    error = ModelError.of(replace(fitted, names=names), truth.robot)
    assert error.left_out == names[-1:]
    np.testing.assert_array_equal(error.cov, ModelError.of(fitted, truth.robot).cov[:-1, :-1])
    base_names = tuple(f"{name} of an arm with joints left out" for name in fitted.value.base_names)
    other = ModelError.of(replace(fitted.value, base_names=base_names), truth.robot)
    assert other.base is None
    assert other.cov.shape == (0, 0)


def test_what_gains_have_in_common_is_no_error_of_the_torque_that_is_read(fitted, truth) -> None:
    """With gain errors, the SD of the arm's weight is 2 % of it; the torque that the model predicts is known better."""
    model, p = fitted.value, len(fitted.value.base_names)
    error = ModelError.of(fitted, truth.robot)
    index = [error.names.index(name) for name in model.base_names]
    apart = error.cov[np.ix_(index, index)]
    assert np.linalg.eigvalsh(error.cov).min() > -1e-9 * np.linalg.eigvalsh(fitted.cov).max()  # of which it is a part
    whole, held = (model.base_values @ C @ model.base_values for C in (fitted.cov[:p, :p], model.base_cov))
    weight = float(model.base_values @ model.base_values)
    assert whole - held > 0.015**2 * weight**2
    assert model.base_values @ apart @ model.base_values - held < 0.2 * (whole - held)


# Physical consistency.


needs_cvxpy = pytest.mark.skipif(find_spec("cvxpy") is None, reason="the extra sdp is not installed")


def shifted(fit: Fit, base_values: np.ndarray, robot) -> Fit:
    """The fit with other base parameters, as another record would have given."""
    base = dynamics.base_parameters(robot)
    links, rotor = base.links_and_rotors(base_values)
    parameters = np.concatenate([base_values, fit.parameters[len(base_values) :]])
    value = replace(fit.value, link_parameters=links, rotor=rotor, base_values=base_values)
    return replace(fit, value=value, parameters=parameters)


def test_pseudo_inertia_is_made_of_moments() -> None:
    """For point masses: the sum of m [x; 1] [x; 1]^T."""
    rng = np.random.default_rng(0)
    masses, points = rng.uniform(0.1, 1.0, 5), rng.standard_normal((5, 3))
    pi = sum(inertia.from_body(m, x, np.zeros((3, 3))) for m, x in zip(masses, points))
    lifted = np.column_stack([points, np.ones(5)])
    np.testing.assert_allclose(pseudo_inertia(pi), (masses[:, None] * lifted).T @ lifted, atol=1e-12)
    assert pseudo_inertia(np.zeros((2, 3, 10))).shape == (2, 3, 4, 4)
    with pytest.raises(ShapeError, match="10"):
        pseudo_inertia(np.zeros(4))


@needs_cvxpy
@pytest.mark.parametrize("pull", ["log-det", "euclidean"])
def test_true_bodies_stay(truth, fitted, pull: str) -> None:
    """Base parameters of real bodies, with these bodies as the prior: no change is needed."""
    robot = truth.robot
    bodies = sim.synthetic_truth(robot).pi
    values = dynamics.base_parameters(robot).B @ np.concatenate([bodies.ravel(), truth.rotor])
    found = physically_consistent(shifted(fitted, values, robot), robot, prior=bodies, pull=pull)
    assert isinstance(found, PhysicallyConsistent)
    np.testing.assert_allclose(found.links, bodies, atol=1e-4)
    np.testing.assert_allclose(found.rotor, truth.rotor, atol=1e-4)
    assert found.distance < 0.1
    assert found.growth < 1e-6


@pytest.fixture(scope="module")
def bodies(truth, fitted) -> PhysicallyConsistent:
    return physically_consistent(fitted, truth.robot)


@needs_cvxpy
def test_an_identified_model_gets_bodies_without_a_prior(fitted, bodies) -> None:
    assert np.linalg.eigvalsh(pseudo_inertia(fitted.value.link_parameters)).min() < 0
    found = bodies
    assert np.linalg.eigvalsh(pseudo_inertia(found.links)).min() > LEAST * (1 - 1e-6)
    assert np.all(found.rotor >= 0)
    assert found.growth < 0.01
    moments = inertia.principal_moments(found.links)
    assert np.all(moments[:, 0] + moments[:, 1] >= moments[:, 2])
    assert "residual increases" in found.text()
    q = np.random.default_rng(1).uniform(-1, 1, (50, 7))
    zero = np.zeros_like(q)
    np.testing.assert_allclose(
        found.model.rigid_torque(q, zero, zero), fitted.value.rigid_torque(q, zero, zero), atol=0.1
    )


@needs_cvxpy
def test_an_impossible_fit_becomes_possible(truth, fitted, bodies) -> None:
    """A last link whose inertia is too small by far more than the log allows."""
    base = dynamics.base_parameters(truth.robot)
    wrong = np.array(fitted.value.base_values)
    wrong[[name.startswith("I_xx7") for name in base.names]] -= 0.02
    found = physically_consistent(shifted(fitted, wrong, truth.robot), truth.robot)
    assert np.linalg.eigvalsh(pseudo_inertia(found.links)).min() > LEAST * (1 - 1e-6)
    assert found.growth > bodies.growth
    assert found.distance > 3.0


@needs_cvxpy
def test_the_residual_of_the_log_grows_as_stated(truth, fitted, excited) -> None:
    """Strong regularisation towards bodies that are too heavy, checked against the filtered residual of the log."""
    heavy = 3.0 * sim.synthetic_truth(truth.robot).pi
    found = physically_consistent(fitted, truth.robot, prior=heavy, pull="euclidean", strength=3e4)

    def rms(model) -> float:
        left = model_residuals(excited, model)
        return float(np.sqrt(np.mean((left.data.filter(left.y, left.data.rate / 10) / fitted.sigma) ** 2)))

    growth = rms(found.model) / rms(fitted.value) - 1
    assert growth > 0.005
    assert found.growth == pytest.approx(growth, rel=0.25)


@needs_cvxpy
def test_simulator_and_urdf_take_the_links(truth, bodies, tmp_path) -> None:
    found = bodies
    robot = replace(truth.robot, inertias=found.links)
    robots.save(robot, tmp_path / "arm.urdf")
    again = robots.load(tmp_path / "arm.urdf", tip="tool")
    np.testing.assert_allclose(again.inertias, found.links, atol=1e-9)
    template = sim.synthetic_truth(robot)
    arm = sim.SimulatedArm(robot, replace(template, pi=found.links, rotor=found.rotor))
    arm.step(robot.q_home, np.zeros(7), None)
    assert np.isfinite(arm.sample.tau).all()


@needs_cvxpy
def test_a_load_becomes_a_body(truth, model, brief) -> None:
    """A point mass has no inertia about its centre: half of its fits are unphysical, with a physical body nearby."""
    fit = fit_payload(carrying(truth, POINT).log(brief, seed=3), model, truth.robot, "dynamic")
    assert np.linalg.eigvalsh(pseudo_inertia(fit.value.pi)).min() < 0
    body = physically_consistent_load(fit)
    assert np.linalg.eigvalsh(pseudo_inertia(body.value.pi)).min() > -1e-12
    assert np.all(np.abs(body.parameters - POINT) < 4 * fit.sd)
    assert "deviations to become physically consistent" in body.report()
    with pytest.raises(ConfigError, match="dynamic"):
        physically_consistent_load(fit_payload(truth.log(brief, seed=3), model, truth.robot))
