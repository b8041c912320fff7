"""Zero-phase filters and derivatives."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import ShapeError
from armlab.signals import central_diff, lowpass_offline


def test_lowpass_offline_has_no_phase_and_the_gain_of_two_passes() -> None:
    t = np.arange(5000) / 250.0
    x = np.sin(2 * np.pi * 5.0 * t)
    y = lowpass_offline(x, 250.0, 5.0)
    middle = slice(1000, 4000)
    gain = (y[middle] @ x[middle]) / (x[middle] @ x[middle])
    assert gain == pytest.approx(0.5, abs=1e-3)  # two passes of -3 dB each at the corner
    quadrature = np.cos(2 * np.pi * 5.0 * t)
    assert abs(y[middle] @ quadrature[middle]) / (x[middle] @ x[middle]) < 1e-3


def test_central_diff_is_exact_for_parabolas_on_uneven_stamps() -> None:
    t = np.cumsum(np.random.default_rng(0).uniform(0.5, 1.5, 50))
    x = np.stack([t**2, 3 * t], axis=1)
    np.testing.assert_allclose(central_diff(x, t), np.stack([2 * t, np.full(50, 3.0)], axis=1), rtol=1e-9)


def test_bad_input_is_refused_with_a_sentence() -> None:
    with pytest.raises(ShapeError, match="cut-off between 0 and 125 Hz"):
        lowpass_offline(np.zeros(100), 250.0, 200.0)
    with pytest.raises(ShapeError, match="at least 16 samples"):
        lowpass_offline(np.zeros(5), 250.0, 10.0)
    with pytest.raises(ShapeError, match=r"NaN or Inf in 1 rows, first \[7\]"):
        lowpass_offline(np.where(np.arange(100)[:, None] == 7, np.nan, np.ones((100, 2))), 250.0, 10.0)
    with pytest.raises(ShapeError, match="strictly increasing"):
        central_diff(np.zeros(4), np.array([0.0, 1.0, 1.0, 2.0]))
