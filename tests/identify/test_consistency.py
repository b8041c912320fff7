"""Links that are bodies: true ones stay, impossible ones become possible at the cost that is stated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab import identify, robots, sim
from armlab.errors import ConfigError, ShapeError
from armlab.estimation import Fit
from armlab.identify import fit_payload, physically_consistent, physically_consistent_load
from armlab.identify.consistency import LEAST, PhysicallyConsistent, pseudo_inertia
from armlab.identify.residuals import model_residuals
from armlab.robots import inertia


@pytest.fixture(scope="module", autouse=True)
def solver():
    return pytest.importorskip("cvxpy", reason="the extra sdp is not installed")


def shifted(fit: Fit, base_values: np.ndarray, robot) -> Fit:
    """The fit with other base parameters, as another record would have given."""
    base = identify.base_parameters(robot)
    links, rotor = base.links_and_rotors(base_values)
    parameters = np.concatenate([base_values, fit.parameters[len(base_values) :]])
    value = replace(fit.value, link_parameters=links, rotor=rotor, base_values=base_values)
    return replace(fit, value=value, parameters=parameters)


def test_pseudo_inertia_is_made_of_moments() -> None:
    """Of points: the sum of m [x; 1] [x; 1]^T."""
    rng = np.random.default_rng(0)
    masses, points = rng.uniform(0.1, 1.0, 5), rng.standard_normal((5, 3))
    pi = sum(inertia.from_body(m, x, np.zeros((3, 3))) for m, x in zip(masses, points))
    lifted = np.column_stack([points, np.ones(5)])
    np.testing.assert_allclose(pseudo_inertia(pi), (masses[:, None] * lifted).T @ lifted, atol=1e-12)
    assert pseudo_inertia(np.zeros((2, 3, 10))).shape == (2, 3, 4, 4)
    with pytest.raises(ShapeError, match="10"):
        pseudo_inertia(np.zeros(4))


@pytest.mark.parametrize("pull", ["log-det", "euclidean"])
def test_true_bodies_stay(truth, fitted, pull: str) -> None:
    """Base parameters of real bodies, with these bodies as the prior: nothing is to be done."""
    robot = truth.robot
    bodies = sim.synthetic_truth(robot).pi
    values = identify.base_parameters(robot).B @ np.concatenate([bodies.ravel(), truth.rotor])
    found = physically_consistent(shifted(fitted, values, robot), robot, prior=bodies, pull=pull)
    assert isinstance(found, PhysicallyConsistent)
    np.testing.assert_allclose(found.links, bodies, atol=1e-4)
    np.testing.assert_allclose(found.rotor, truth.rotor, atol=1e-4)
    assert found.distance < 0.1
    assert found.growth < 1e-6


def test_an_identified_model_gets_bodies_without_a_prior(truth, fitted) -> None:
    assert np.linalg.eigvalsh(pseudo_inertia(fitted.value.link_parameters)).min() < 0
    found = physically_consistent(fitted, truth.robot)
    assert np.linalg.eigvalsh(pseudo_inertia(found.links)).min() > LEAST * (1 - 1e-6)
    assert np.all(found.rotor >= 0)
    assert found.growth < 0.01
    moments = inertia.principal_moments(found.links)
    assert np.all(moments[:, 0] + moments[:, 1] >= moments[:, 2])
    assert "residual grows" in found.text()
    q = np.random.default_rng(1).uniform(-1, 1, (50, 7))
    zero = np.zeros_like(q)
    np.testing.assert_allclose(
        found.model.rigid_torque(q, zero, zero), fitted.value.rigid_torque(q, zero, zero), atol=0.1
    )


def test_an_impossible_fit_becomes_possible(truth, fitted) -> None:
    """A last link whose inertia is too small by far more than the log allows."""
    base = identify.base_parameters(truth.robot)
    wrong = np.array(fitted.value.base_values)
    wrong[[name.startswith("I_xx7") for name in base.names]] -= 0.02
    found = physically_consistent(shifted(fitted, wrong, truth.robot), truth.robot)
    assert np.linalg.eigvalsh(pseudo_inertia(found.links)).min() > LEAST * (1 - 1e-6)
    assert found.growth > physically_consistent(fitted, truth.robot).growth
    assert found.distance > 3.0


def test_the_residual_of_the_log_grows_as_stated(truth, fitted, excited) -> None:
    """Pulled hard to bodies that are too heavy: what the log's own residual, filtered, says of it."""
    heavy = 3.0 * sim.synthetic_truth(truth.robot).pi
    found = physically_consistent(fitted, truth.robot, prior=heavy, pull="euclidean", strength=3e4)

    def rms(model) -> float:
        left = model_residuals(excited, model)
        return float(np.sqrt(np.mean((left.data.filter(left.y, left.data.rate / 10) / fitted.sigma) ** 2)))

    growth = rms(found.model) / rms(fitted.value) - 1
    assert growth > 0.005
    assert found.growth == pytest.approx(growth, rel=0.25)


def test_simulator_and_urdf_take_the_links(truth, fitted, tmp_path) -> None:
    found = physically_consistent(fitted, truth.robot)
    robot = replace(truth.robot, inertias=found.links)
    robots.save(robot, tmp_path / "arm.urdf")
    again = robots.load(tmp_path / "arm.urdf", tip="tool")
    np.testing.assert_allclose(again.inertias, found.links, atol=1e-9)
    template = sim.synthetic_truth(robot)
    arm = sim.SimulatedArm(robot, replace(template, pi=found.links, rotor=found.rotor))
    arm.step(robot.q_home, np.zeros(7), None)
    assert np.isfinite(arm.sample.tau).all()


def test_a_load_becomes_a_body(truth, model) -> None:
    """A point has no inertia about itself: half of the fits of one are no body, and a body is near."""
    robot = truth.robot
    point = inertia.from_body(0.5, [0.03, 0.0, 0.052], np.zeros((3, 3)))
    links = truth.links.copy()
    links[-1] += inertia.transform(robot.links[-1], point)
    motion = identify.design_excitation(robot, seconds=12, speed=0.4, seed=3)
    fit = fit_payload(replace(truth, links=links).log(motion, seed=3), model, robot, "dynamic")
    assert np.linalg.eigvalsh(pseudo_inertia(fit.value.pi)).min() < 0
    body = physically_consistent_load(fit)
    assert np.linalg.eigvalsh(pseudo_inertia(body.value.pi)).min() > -1e-12
    assert np.all(np.abs(body.parameters - point) < 4 * fit.sd)
    assert "deviations to a body" in body.report()
    with pytest.raises(ConfigError, match="dynamic"):
        physically_consistent_load(fit_payload(truth.log(motion, seed=3), model, robot))
