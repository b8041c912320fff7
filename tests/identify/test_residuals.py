"""What a model leaves of a log."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab.errors import ShapeError
from armlab.identify.residuals import Residuals, friction_signs, model_residuals
from armlab.kernels import presliding
from armlab.log import Table
from armlab.models import TorqueModel


def test_residuals_are_measured_minus_modelled_torque(model: TorqueModel, excited: Table) -> None:
    found = model_residuals(excited, model)
    assert isinstance(found, Residuals)
    assert np.all(np.std(found.y, axis=0) < 0.3 * np.std(excited["tau"], axis=0))
    z = presliding(excited["q"], model.friction.delta, model.friction.resolution)
    assert np.array_equal(found.s, z)
    assert np.array_equal(friction_signs(model, found.data), z)
    smooth = replace(model, friction=replace(model.friction, smooth_speed=np.full(7, 0.05)))
    np.testing.assert_allclose(model_residuals(excited, smooth).s, np.tanh(excited["qd"] / 0.05))


def test_the_log_of_another_arm_is_refused(model: TorqueModel, excited: Table) -> None:
    six = Table(excited.t, {name: excited[name][:, :6] for name in ("q", "qd", "tau")})
    with pytest.raises(ShapeError, match="yumi_left"):
        model_residuals(six, model)
