"""Noise of torque and velocity for the momentum estimators."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import ShapeError
from armlab.models import FORCE_RATES, PRIOR, MomentumNoise


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
