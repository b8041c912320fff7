"""Defects of DynamicMovementPrimitives.jl and pitfalls of its peers that armlab must not repeat.

They are listed in docs/decisions/ancestor.md; those of the two-link arm are tested with it.
"""

from __future__ import annotations

import numpy as np
import pytest

from armlab.motion import Displace, Hold, TwoDofDmp, fit_dmp
from armlab.motion.primitive.equation import placed

T = np.linspace(0, 10, 1510)
RAMP = np.concatenate([np.zeros(10), np.linspace(0, 2, 1000), np.full(500, 2.0)])[:, None]


def test_3_kernels_are_where_the_motion_is() -> None:
    times = -np.log(placed("canonical", "time", 15, 3.0, 0.8)[0]) / 3.0
    np.testing.assert_allclose(np.diff(times), 1 / 14, rtol=1e-9)
    late = -np.log(placed("canonical", "phase", 15, 3.0, 0.8)[0]) / 3.0 > 0.5
    assert late.sum() == 3


def test_4_widths_are_of_the_size_of_the_gaps() -> None:
    for schedule in ("canonical", "time"):
        centres, widths = placed(schedule, "time", 15, 3.0, 0.8)
        np.testing.assert_allclose(widths[:-1], 0.8 * abs(np.diff(centres)), rtol=1e-12)


def test_6_the_forcing_of_time_ends() -> None:
    dmp = fit_dmp(T, RAMP, schedule="time", n_basis=15).value
    run = dmp.rollout(np.linspace(0, 20, 3000))
    assert abs(run.forcing[run.t > 11.0]).max() == 0.0
    assert abs(run.y[-1] - 2.0) < 1e-6


def test_7_the_forcing_follows_goal_and_start() -> None:
    dmp = fit_dmp(T, RAMP, method="lwr", n_basis=15, spacing="phase").value
    at = [0.0, 0.5]
    assert dmp.solve(at, g=[3.0]).y[-1, 0] == pytest.approx(0.18991233, abs=1e-7)
    np.testing.assert_allclose(dmp.rollout(T, y0=[1.0], g=[3.0]).y, dmp.rollout(T).y + 1, atol=1e-12)


def test_11_late_samples_weigh_as_much_as_early_ones() -> None:
    """The ancestor divides by ``x (g - y0)``, which is small at the end."""
    fit = fit_dmp(T, RAMP, method="acceleration", n_basis=15)
    x = fit.value.phase(T)
    A = fit.value.kernels(x) * x[:, None]
    asked = fit.residuals[:, 0] + A @ fit.value.weights[:, 0]
    divided = np.linalg.pinv(fit.value.kernels(x)) @ (asked / x)
    assert (fit.residuals**2).sum() < ((asked - A @ divided) ** 2).sum()


def test_16_a_blow_does_not_make_it_stiff() -> None:
    """A displacement of 2: with the state yc', a term of 1000 per second, too stiff for steps of 4 ms."""
    two_dof, t = TwoDofDmp(fit_dmp(T, RAMP, method="lwr", n_basis=15, spacing="phase").value), np.arange(0.0, 10.0, 0.1)
    events = [Displace(2.5, 2.0), Hold(2.5, 4.0)]
    coarse, fine = (two_dof.simulate(t, events, dt=dt) for dt in (4e-3, 5e-4))
    np.testing.assert_allclose(coarse.yc, fine.yc, rtol=0, atol=1e-3)
