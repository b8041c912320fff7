"""A load: what it is, its file, and the model of the arm that carries it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab.errors import ModelMismatchError, ShapeError
from armlab.models import Payload, load, save
from armlab.robots import inertia

CENTRE = np.array([0.03, -0.01, 0.06])
ABOUT = np.diag([1e-3, 2e-3, 1.5e-3])


@pytest.fixture
def payload(truth) -> Payload:
    robot = truth.robot
    return Payload(robot.name, robot.hash, inertia.from_body(0.5, CENTRE, ABOUT), robot.links[-1], ("log sha256:0",))


def test_mass_centre_and_inertia(payload: Payload) -> None:
    assert payload.mass == pytest.approx(0.5)
    np.testing.assert_allclose(payload.centre, CENTRE, atol=1e-15)
    np.testing.assert_allclose(payload.inertia, ABOUT, atol=1e-15)
    with pytest.raises(ValueError, match="read-only"):
        payload.pi[0] = 1.0


def test_a_model_that_carries_it_feels_its_weight(payload: Payload, truth, model) -> None:
    """At rest: J^T of the weight at the centre of mass."""
    robot, q = truth.robot, truth.robot.q_home + 0.2
    loaded = payload.added_to(model)
    zero = np.zeros(robot.n)
    change = loaded.rigid_torque(q, zero, zero) - model.rigid_torque(q, zero, zero)
    T_base_flange = robot.chain.forward(q)
    arm = T_base_flange[:3, :3] @ CENTRE
    weight = 0.5 * robot.gravity
    wrench = np.concatenate([weight, np.cross(arm, weight)])
    np.testing.assert_allclose(change, -robot.chain.jacobian(q).T @ wrench, atol=1e-12)
    np.testing.assert_array_equal(loaded.base_values, model.base_values)


def test_another_robot_and_bad_numbers_are_refused(payload: Payload, model) -> None:
    with pytest.raises(ModelMismatchError, match="yumi_left"):
        replace(payload, robot_hash="other").added_to(model)
    with pytest.raises(ShapeError, match=r"pi of shape \(10,\)"):
        replace(payload, pi=np.zeros(4))
    with pytest.raises(ShapeError, match="finite"):
        replace(payload, pi=np.full(10, np.nan))


def test_its_file_is_bit_equal(payload: Payload, tmp_path) -> None:
    again = load(save(payload, tmp_path / "load.toml"), kind="payload")
    assert np.array_equal(again.pi, payload.pi)
    assert np.array_equal(again.T_last_flange, payload.T_last_flange)
    assert (again.robot_hash, again.sources) == (payload.robot_hash, payload.sources)
