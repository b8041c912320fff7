"""What is uncertain in a model: the slopes of its torque, and which parameters are known by name."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab import identify
from armlab.identify.payload import LoadRecord, ModelError
from armlab.log import Table


@pytest.fixture(scope="module")
def table(truth) -> Table:
    return truth.log(identify.design_excitation(truth.robot, seconds=10, speed=0.4, acceleration=8.0, seed=3), seed=3)


STEPS = {"viscous": 0.1, "coulomb_pos": 0.1, "coulomb_neg": 0.1, "offset": 0.1, "stribeck": 0.1, "delta": 1e-6}
TERMS = {"coulomb_pos": "coulomb+", "coulomb_neg": "coulomb-"}


@pytest.mark.parametrize("field", STEPS)
def test_a_changed_model_changes_the_sums_as_said(truth, fitted, table, field: str) -> None:
    """A_i^T (y of the changed model - y) is minus the sums times the change, for every joint."""
    robot, model, step = truth.robot, fitted.value, STEPS[field]
    joint = 2
    one = np.eye(robot.n)[joint] * step
    changed = replace(model, friction=replace(model.friction, **{field: getattr(model.friction, field) + one}))
    name = f"{TERMS.get(field, field)} {robot.joint_names[joint]}"
    name = identify.base_parameters(robot).offset_names[joint] if field == "offset" else name
    names, p = (*model.base_names, name), len(model.base_names)
    known = replace(fitted, names=names, units=("1",) * (p + 1), parameters=np.zeros(p + 1), cov=np.eye(p + 1))
    record, other = LoadRecord.of(table, known, robot), LoadRecord.of(table, changed, robot)
    sums = np.einsum("kia,ki->ia", record.A, other.y - record.y)
    np.testing.assert_allclose(sums, -step * record.against[:, :, p], atol=2e-3 * np.abs(sums).max())
    assert np.abs(sums[joint]).max() > 0


def test_every_parameter_of_a_fit_is_known_by_name(truth, fitted) -> None:
    error = ModelError.of(fitted, truth.robot)
    assert error.names == fitted.names
    assert error.left_out == ()
    held = replace(fitted, value=replace(fitted.value, gain_cov=np.zeros((7, 7))))
    np.testing.assert_array_equal(ModelError.of(held, truth.robot).cov, fitted.cov)
    alone = ModelError.of(fitted.value, truth.robot)
    assert alone.names == fitted.value.base_names
    np.testing.assert_array_equal(alone.cov, fitted.value.base_cov)


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
    """The deviation of the weight of the arm is 2 % of it with the gains; what the model predicts is known better."""
    model, p = fitted.value, len(fitted.value.base_names)
    error = ModelError.of(fitted, truth.robot)
    index = [error.names.index(name) for name in model.base_names]
    apart = error.cov[np.ix_(index, index)]
    assert np.linalg.eigvalsh(error.cov).min() > -1e-9 * np.linalg.eigvalsh(error.cov).max()
    whole, held = (model.base_values @ C @ model.base_values for C in (fitted.cov[:p, :p], model.base_cov))
    weight = float(model.base_values @ model.base_values)
    assert whole - held > 0.015**2 * weight**2
    assert model.base_values @ apart @ model.base_values - held < 0.2 * (whole - held)
