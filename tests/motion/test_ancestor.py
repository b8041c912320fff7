"""Defects of DynamicMovementPrimitives.jl and traps of its peers that are not to come here.

Their table is docs/decisions/ancestor.md; those of the two-link arm have their tests with it.
"""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from armlab.motion import Displace, Dmp, Hold, TwoDofDmp, fit_dmp
from armlab.motion.primitive.equation import placed

ROOT = Path(__file__).parents[2]

T = np.linspace(0, 10, 1510)
RAMP = np.concatenate([np.zeros(10), np.linspace(0, 2, 1000), np.full(500, 2.0)])[:, None]


@pytest.mark.parametrize("schedule", ["time", "position"])
def test_1_time_and_position_phases_run(schedule: str) -> None:
    dmp = fit_dmp(T, RAMP, schedule=schedule, n_basis=15).value
    assert np.sqrt(((dmp.rollout(T).y - RAMP) ** 2).mean()) < 4e-3


@pytest.mark.parametrize("way", [0.0, 1e-3])
def test_2_no_displacement_gives_weights(way: float) -> None:
    y = np.sin(np.pi * T / 10)[:, None] ** 2 + way * T[:, None] / 10
    for method in ("trajectory", "acceleration", "lwr"):
        weights = fit_dmp(T, y, method=method).value.weights
        assert np.isfinite(weights).all()
        assert abs(weights).max() < 1e3


def test_3_kernels_are_where_the_motion_is() -> None:
    times = -np.log(placed("canonical", "time", 15, 3.0, 0.8)[0]) / 3.0
    np.testing.assert_allclose(np.diff(times), 1 / 14, rtol=1e-9)
    late = -np.log(placed("canonical", "phase", 15, 3.0, 0.8)[0]) / 3.0 > 0.5
    assert late.sum() == 3


def test_4_widths_are_of_the_size_of_the_gaps() -> None:
    for schedule in ("canonical", "time"):
        centres, widths = placed(schedule, "time", 15, 3.0, 0.8)
        np.testing.assert_allclose(widths[:-1], 0.8 * abs(np.diff(centres)), rtol=1e-12)


@pytest.mark.parametrize("n_basis", [378, 1000])
@pytest.mark.parametrize("schedule", ["canonical", "time"])
def test_5_kernels_are_numbers_far_from_all_centres(schedule: str, n_basis: int, primitive: Callable[..., Dmp]) -> None:
    centres, widths = placed(schedule, "phase", n_basis, 3.0, 0.8)
    dmp = primitive(schedule, weights=np.ones((n_basis, 3)), centres=centres, widths=widths)
    psi = dmp.kernels(dmp.phase(np.linspace(0, 100, 300)))
    np.testing.assert_allclose(psi.sum(axis=1), 1.0, rtol=1e-12)


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


def test_8_any_number_of_samples_and_any_duration() -> None:
    dmp = fit_dmp(T, RAMP).value
    for N in (2, 1000, 1001):
        assert dmp.rollout(np.linspace(0, 7, N), duration=7.0).y.shape == (N, 1)
    assert dmp.tau_d == pytest.approx(10 / 3)


def test_9_the_clock_need_not_begin_at_zero() -> None:
    dmp, late = fit_dmp(T, RAMP).value, fit_dmp(T + 1e3, RAMP).value
    assert late.tau_d == pytest.approx(dmp.tau_d, rel=1e-12)
    np.testing.assert_allclose(late.rollout(T + 1e3).y, dmp.rollout(T).y, atol=1e-9)


def test_10_a_stop_of_one_joint_keeps_the_path_together() -> None:
    both = np.concatenate([RAMP, RAMP / 2], axis=1)
    dmp = fit_dmp(T, both, method="lwr", n_basis=15, spacing="phase").value
    run = TwoDofDmp(dmp).simulate(np.arange(0.0, 10.5, 0.5), [Hold(2.5, 4.0, [0])], dt=0.01)
    np.testing.assert_allclose(run.yc[:, 1], run.yc[:, 0] / 2, rtol=0, atol=1e-9)
    assert abs(run.yc - run.free.y)[run.t == 6.0].min() > 0.3


def test_11_late_samples_weigh_as_much_as_early_ones() -> None:
    """The ancestor divides by ``x (g - y0)``, which is small at the end."""
    fit = fit_dmp(T, RAMP, method="acceleration", n_basis=15)
    x = fit.value.phase(T)
    A = fit.value.kernels(x) * x[:, None]
    asked = fit.residuals[:, 0] + A @ fit.value.weights[:, 0]
    divided = np.linalg.pinv(fit.value.kernels(x)) @ (asked / x)
    assert (fit.residuals**2).sum() < ((asked - A @ divided) ** 2).sum()


def test_13_the_shaded_time_is_that_of_the_stop() -> None:
    run = TwoDofDmp(fit_dmp(T, RAMP, n_basis=15).value).simulate(T, [Hold(2.5, 4.0)], dt=0.01)
    assert run.disturbed == ((2.5, 4.0),)
    still = np.flatnonzero(run.ya[:, 0] == run.ya[500, 0])
    assert (still[0], still[-1]) == (378, 603)  # not 400 to 600


def test_14_a_hold_stops_the_arm() -> None:
    run = TwoDofDmp(fit_dmp(T, RAMP, n_basis=15).value).simulate(T, [Hold(2.5, 4.0)], dt=0.01)
    held = (run.t > 2.5) & (run.t < 4.0)
    np.testing.assert_array_equal(run.yad[held], 0.0)
    assert np.ptp(run.ya[held]) == 0.0


def test_15_long_steps_stay_on_the_solution() -> None:
    two_dof, at = TwoDofDmp(fit_dmp(T, RAMP, method="lwr", n_basis=15, spacing="phase").value), [0.0, 6.0]
    coarse, fine = (two_dof.simulate(at, [Hold(2.5, 4.0)], dt=dt).yc[-1] for dt in (10 / 1509, 1e-3))
    np.testing.assert_allclose(coarse, fine, rtol=0, atol=5e-6)  # a thousandth of Euler's error


def test_16_a_blow_does_not_make_it_stiff() -> None:
    """A displacement of 2: in the state yc' a term of 1000 per second, which steps of 4 ms do not follow."""
    two_dof, t = TwoDofDmp(fit_dmp(T, RAMP, method="lwr", n_basis=15, spacing="phase").value), np.arange(0.0, 10.0, 0.1)
    events = [Displace(2.5, 2.0), Hold(2.5, 4.0)]
    coarse, fine = (two_dof.simulate(t, events, dt=dt) for dt in (4e-3, 5e-4))
    np.testing.assert_allclose(coarse.yc, fine.yc, rtol=0, atol=1e-3)


def test_peers_forget_a_dependency() -> None:
    """Whatever motion imports at once, and not only for an extra, is declared."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    declared = {re.split(r"[<>=\[ ]", one)[0].replace("-", "_") for one in project["dependencies"]}
    imported = set()
    for path in (ROOT / "src" / "armlab" / "motion").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [one.name for one in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            imported |= {name.split(".")[0] for name in names}
    assert imported - set(sys.stdlib_module_names) - declared == {"armlab", "ruckig"}
    assert any(one.startswith("ruckig") for one in project["optional-dependencies"]["motion"])


def test_peers_start_at_rest_and_return_no_velocity() -> None:
    t = np.linspace(0, 1, 1000)
    y = np.sin(0.45 * np.pi * t + 0.3)[:, None]
    run = fit_dmp(t, y, hold=0.0).value.rollout(t)
    assert run.yd[0, 0] == pytest.approx(0.45 * np.pi * np.cos(0.3), rel=5e-3)
    assert run.yd.shape == run.y.shape == (1000, 1)
