"""Noise models: torque covariance over velocity, momentum estimators."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import ShapeError, UnknownName
from armlab.models import FORCE_RATES, PRIOR, MomentumNoise, VelocityCovariance, velocity_covariance


def test_velocity_covariance_kinds() -> None:
    C0, Cinf = [4.0, 1.0], [1.0, 1.0]
    exp = velocity_covariance("exp", C0, Cinf, [10.0, 10.0], alpha2=2.0)
    assert isinstance(exp, VelocityCovariance)
    np.testing.assert_allclose(exp.variance([0.0, 0.0]), [8.0, 2.0])
    np.testing.assert_allclose(exp.variance([-0.1, 5.0]), [2 * (1 + 3 * np.exp(-1.0)), 2.0])
    step = velocity_covariance("step", C0, Cinf, [0.1, 0.1])
    np.testing.assert_allclose(step.variance([[0.05, 0.05], [0.2, -0.2]]), [[4.0, 1.0], [1.0, 1.0]])
    np.testing.assert_allclose(velocity_covariance("const", C0, Cinf).variance([0.0, 0.0]), [1.0, 1.0])


def test_nonsense_is_refused() -> None:
    with pytest.raises(UnknownName, match="const, exp, step"):
        velocity_covariance("linear", [1.0], [1.0])
    with pytest.raises(ShapeError, match="C0 >= Cinf > 0"):
        velocity_covariance("exp", [1.0], [2.0], [1.0])
    for numbers in ({"alpha2": np.nan}, {"alpha2": 0.0}, {"alpha2": -1.0}, {"alpha2": np.inf}, {"shape": [np.nan]}):
        with pytest.raises(ShapeError, match="finite"):
            velocity_covariance(**{"kind": "exp", "C0": [2.0], "Cinf": [1.0], "shape": [1.0], **numbers})
    for C0, Cinf, shape in (([np.inf], [1.0], [1.0]), ([np.nan], [np.nan], [1.0]), ([2.0], [1.0], [-1.0])):
        with pytest.raises(ShapeError, match="Expected"):
            velocity_covariance("exp", C0, Cinf, shape)


# Noise of torque and velocity for the momentum estimators.


def test_momentum_noise_is_frozen_and_checked() -> None:
    noise = MomentumNoise(memory=[0.02, 0.03], qd_noise=[1e-3, 0.0])
    assert (noise.alpha2_observer, noise.alpha2_kf) == (1.0, 1.0)
    with pytest.raises(ValueError, match="read-only"):
        noise.memory[0] = 1.0
    for memory, qd_noise, factor in (
        ([0.0, 0.1], [0.0, 0.0], 1.0),
        ([0.1, 0.1], [-1.0, 0.0], 1.0),
        ([0.1], [0.0, 0.0], 1.0),
        ([np.nan], [0.0], 1.0),
        ([0.1], [0.0], 0.0),
    ):
        with pytest.raises(ShapeError, match="memory > 0"):
            MomentumNoise(memory, qd_noise, alpha2_kf=factor)


def test_defaults_are_a_wrench_each() -> None:
    assert len(PRIOR) == 6
    assert [FORCE_RATES[name][0] for name in ("smooth", "normal", "fast")] == [2.0, 5.0, 20.0]
    assert all(len(rate) == 6 for rate in FORCE_RATES.values())
