"""Both sets of kernels of orientations: the chart of a step is of fourth order where the axis turns fast."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from armlab import kernels
from armlab.kernels import _reference
from armlab.kernels._reference.rotation_primitive import chart
from armlab.lie import so3


def test_the_chart_is_the_inverse_of_the_left_jacobian_to_third_order() -> None:
    theta, z = np.array([0.03, -0.02, 0.05]), np.array([1.0, 2.0, -3.0])
    np.testing.assert_allclose(chart(theta, z), so3.left_jacobian_inv(theta) @ z, rtol=0, atol=1e-7)


@pytest.mark.parametrize("module", [kernels, _reference], ids=["kernels", "reference"])
def test_order_is_four_where_a_force_turns_the_axis(module: Any) -> None:
    """A soft spring, so that steps are long for the rotation; without ``theta x (theta x z) / 12`` it is three."""
    weights = np.tile([30.0, -40.0, 20.0], (4, 1))
    p = module.Primitive(np.linspace(0.0, 1.0, 4), np.full(4, 0.3), weights, 1.0, 1.0, 1.0, 1.0, "canonical")
    start, goal = np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.8, 0.0, 0.6, 0.0])
    ends = [
        module.rotation_rollout(p, np.linspace(0, 0.2, n + 1), 1.0, start, np.array([0.0, 8.0, 0.0]), goal, np.eye(3))
        for n in (20, 40, 240)
    ]
    coarse, better = (np.linalg.norm(q[-1] - ends[-1][0][-1]) for q, *_ in ends[:2])
    assert np.log2(coarse / better) > 3.7
