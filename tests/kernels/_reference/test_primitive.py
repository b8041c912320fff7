"""Both sets of kernels of movement primitives against closed forms: the gate of time, one step of the spring."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from armlab import kernels
from armlab.kernels import _reference

both = pytest.mark.parametrize("module", [kernels, _reference], ids=["kernels", "reference"])


def primitive(module: Any, weights: Any, alpha: float = 25.0, stiffness: float = 156.25, pace: float = 1.0) -> Any:
    """One coordinate with three kernels and a phase of time."""
    centres, widths = np.linspace(0.0, 1.0, 3), np.full(3, 0.4)
    return module.Primitive(centres, widths, np.reshape(weights, (3, 1)), alpha, stiffness, 1.0, pace, "time")


@both
def test_the_gate_of_time_is_the_quintic_smooth_step(module: Any) -> None:
    """From 1 at x = 1 to 0 at 1.1, where its second derivative is zero as beside them."""
    gate = primitive(module, np.ones(3)).forcing  # kernels sum to 1
    u = np.linspace(-3.0, 3.0, 121)
    late = u.clip(0.0, 1.0)
    wanted = 1.0 - (10 * late**3 - 15 * late**4 + 6 * late**5)
    np.testing.assert_allclose(gate(1.0 + 0.1 * u)[:, 0], wanted, rtol=0, atol=1e-12)
    h = 1e-4
    for end in (1.0, 1.1):
        before, at, after = gate(end + h * np.array([-1.0, 0.0, 1.0]))[:, 0]
        assert abs(before - 2 * at + after) / h**2 < 2.0  # 300 with a cubic step, 1e5 with a line


SPRINGS = {  # damping and stiffness; near critical both sides, for the series of cosh and cos
    "critical": (25.0, 156.25),
    "nearly, above": (25.0, 156.25 - 1e-6),
    "nearly, below": (25.0, 156.25 + 1e-6),
    "overdamped": (25.0, 100.0),
    "underdamped": (25.0, 2000.0),
    "hardly damped": (1.0, 1e4),
}


@both
@pytest.mark.parametrize("spring", SPRINGS)
def test_a_step_of_any_length_is_exact_for_a_quadratic_force(module: Any, spring: str) -> None:
    alpha, stiffness = SPRINGS[spring]
    A = np.zeros((5, 5))  # of y - g, y', 1, s, s^2
    A[0, 1], A[3, 2], A[4, 3] = 1.0, 1.0, 2.0
    for r in (1e-3, 9e-3, 0.038, 0.041, 0.3, 0.9, 3.0):  # time constants: a step is long from 0.04 or 0.01 on
        p = primitive(module, [20.0, -35.0, 60.0], alpha, stiffness, 1.0 / r)  # the phase goes from 0 to 1 in it
        f0, fm, f1 = p.forcing(np.array([0.0, 0.5, 1.0]))[:, 0]
        A[1] = -stiffness, -alpha, f0, (4 * fm - 3 * f0 - f1) / r, 2 * (f0 - 2 * fm + f1) / r**2
        for y0, v0, g in ((0.0, 0.0, 0.0), (1.0, -2.0, 0.3)):
            y, yd, *_ = p.rollout(np.array([0.0, r]), 1.0, *(np.array([a]) for a in (y0, v0, g, 1.0)))
            wanted = expm(A * r) @ [y0 - g, v0, 1.0, 0.0, 0.0]
            np.testing.assert_allclose([y[1, 0] - g, yd[1, 0]], wanted[:2], rtol=1e-11, err_msg=f"r = {r}")
