"""Logs that are sampled too slowly are refused; lines of ripple that fold back are not used."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import ShapeError
from armlab.identify import prepare
from armlab.identify.record import MIN_RATE, SLOW_SHARE, check_rate, slow_enough
from armlab.log import Table


def test_slow_sampling_is_refused(truth, excited) -> None:
    check_rate(np.arange(0, 1, 1 / MIN_RATE))
    with pytest.raises(ShapeError, match=r"at least 40 Hz, got 10 Hz.*Record faster"):
        check_rate(np.arange(0, 60, 0.1))
    with pytest.raises(ShapeError, match=r"got 0\.25 Hz.*If t is in milliseconds, divide it by 1000"):
        prepare(Table(1000 * excited.t, dict(excited.values)), truth.robot)
    with pytest.raises(ShapeError, match=r"at least 40 Hz, got 10 Hz"):
        prepare(excited.rows(slice(None, None, 25)), truth.robot)


def test_ripple_that_folds_back_is_not_used() -> None:
    """A line of 200 rad/rad at 250 Hz folds from 125 Hz on; a quarter of the rate is 62.5 Hz, 1.96 rad/s."""
    assert SLOW_SHARE == 0.25
    speed = np.array([[0.0, 0.0], [1.9, 1.9], [-2.0, -2.0]])
    expected = [[True, True], [True, True], [False, True]]
    np.testing.assert_array_equal(slow_enough(speed, 250.0, np.array([200.0, 100.0])), expected)
