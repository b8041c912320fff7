"""External axes follow their references."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import ConfigError
from armlab.sim.controller.guidance import ExternalAxes
from armlab.sim.controller.settings import ControllerSettings


def test_axes_follow_no_faster_than_one_radian_a_second() -> None:
    axes = ExternalAxes(2, ControllerSettings())
    axes.follow(None)
    axes.follow(np.array([1.0]))
    np.testing.assert_array_equal(axes.q, 0.0)
    reached = []
    for _ in range(1000):
        axes.follow(np.array([0.5, -2.0, 9.0]))
        reached.append(axes.q)
    assert np.abs(np.diff(reached, axis=0)).max() <= 0.004032 + 1e-12
    np.testing.assert_allclose(axes.q, [0.5, -2.0], atol=1e-2)


@pytest.mark.parametrize("count", [-1, 7])
def test_counts_that_egm_does_not_have(count: int) -> None:
    with pytest.raises(ConfigError, match="external"):
        ExternalAxes(count, ControllerSettings())
