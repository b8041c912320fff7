"""Noise models: torque covariance over velocity, momentum estimators."""

from __future__ import annotations

import numpy as np

from armlab.models import VelocityCovariance, velocity_covariance


def test_velocity_covariance_kinds() -> None:
    C0, Cinf = [4.0, 1.0], [1.0, 1.0]
    exp = velocity_covariance("exp", C0, Cinf, [10.0, 10.0], alpha2=2.0)
    assert isinstance(exp, VelocityCovariance)
    np.testing.assert_allclose(exp.variance([0.0, 0.0]), [8.0, 2.0])
    np.testing.assert_allclose(exp.variance([-0.1, 5.0]), [2 * (1 + 3 * np.exp(-1.0)), 2.0])
    step = velocity_covariance("step", C0, Cinf, [0.1, 0.1])
    np.testing.assert_allclose(step.variance([[0.05, 0.05], [0.2, -0.2]]), [[4.0, 1.0], [1.0, 1.0]])
    np.testing.assert_allclose(velocity_covariance("const", C0, Cinf).variance([0.0, 0.0]), [1.0, 1.0])


# Noise of torque and velocity for the momentum estimators.
