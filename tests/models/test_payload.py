"""A load: what it is, its file, and the model of the arm that carries it."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.models import Payload
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
