"""`plots.velocity_covariance`: sigma over velocity."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.models import TorqueModel, velocity_covariance
from armlab.plots import model as covariances


def test_lines_are_the_square_root_of_the_variance() -> None:
    model = velocity_covariance("exp", np.array([4.0, 1.0]), np.array([1.0, 0.25]), np.array([10.0, 20.0]), alpha2=2.0)
    ax = covariances.velocity_covariance(model, qd_max=0.5)
    assert ax.get_xlabel() == "qd [rad/s]"
    assert ax.get_ylabel() == "sigma of the torque error [N m]"
    for i, line in enumerate(ax.lines):
        qd = np.asarray(line.get_xdata())
        assert (qd[0], qd[-1]) == (-0.5, 0.5)
        expected = np.sqrt(model.variance(np.repeat(qd[:, None], 2, axis=1))[:, i])
        assert np.asarray(line.get_ydata()) == pytest.approx(expected)
        assert line.get_label() == f"joint {i + 1}"
    assert len(ax.lines) == 2


def test_a_torque_model_gives_its_covariance(model: TorqueModel) -> None:
    lines = covariances.velocity_covariance(model).lines
    assert len(lines) == len(model.covariance.C0)
