"""A movement primitive sample by sample: as the rollout, and with a goal that moves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from armlab.errors import ConfigError, ShapeError, UnknownName
from armlab.motion import Dmp, Stepper, fit_dmp

Primitive = Callable[..., Dmp]


@given(st.sampled_from(["canonical", "time", "position"]), st.integers(0, 99))
def test_steps_are_the_rollout(primitive: Primitive, schedule: str, seed: int) -> None:
    dmp = primitive(schedule)
    t = np.cumsum(np.random.default_rng(seed).uniform(1e-3, 0.1, 40))
    run = dmp.rollout(t, g=dmp.g + 1, duration=3.0)
    stepper = dmp.stepper(g=dmp.g + 1, duration=3.0)
    assert isinstance(stepper, Stepper)
    for _ in range(2):
        rows = [stepper.state, *(stepper.step(dt) for dt in np.diff(t))]
        for got, wanted in zip(np.array(rows).swapaxes(0, 1), (run.y, run.yd, run.ydd)):
            np.testing.assert_allclose(got, wanted, atol=1e-12 * (1 + abs(wanted).max()))
        np.testing.assert_allclose(stepper.x, run.x[-1], atol=1e-12)
        assert [stepper.t, stepper.duration] == pytest.approx([t[-1] - t[0], 3.0])
        stepper.reset()


def test_the_velocity_stays_when_the_pace_changes(primitive: Primitive) -> None:
    stepper = primitive().stepper()
    for _ in range(100):
        _, before, _ = stepper.step(0.004)
    stepper.change_duration(5.0)
    np.testing.assert_allclose(stepper.state[1], before, rtol=1e-14)
    for _ in range(5000):
        y, _, _ = stepper.step(0.004)
    np.testing.assert_allclose(y, stepper.goal, atol=1e-3)


def test_bad_arguments_are_refused(primitive: Primitive) -> None:
    dmp = primitive()
    with pytest.raises(UnknownName, match="shift"):
        dmp.stepper(goal_forcing="jump")
    with pytest.raises(ConfigError, match="scaling"):
        primitive(scaling="none").stepper(goal_forcing="scale")
    with pytest.raises(ConfigError, match="goal_rate"):
        dmp.stepper(goal_rate=-1.0)
    with pytest.raises(ShapeError, match="each run"):
        dmp.stepper(g=np.zeros((2, 3)))
    stepper = dmp.stepper()
    for dt in (0.0, -0.1, np.nan):
        with pytest.raises(ShapeError, match="dt"):
            stepper.step(dt)
    for g in (np.zeros(2), np.full(3, np.nan)):
        with pytest.raises(ShapeError):
            stepper.change_goal(g)
    with pytest.raises(ShapeError, match="above zero"):
        stepper.change_duration(0.0)


def reach(dmp: Dmp, when: float, goal: float, **options: Any) -> tuple[np.ndarray, float]:
    """Path after the goal of a motion from 0 to 1 has changed, and the velocity then."""
    stepper = dmp.stepper(**options)
    path = [stepper.step(0.002)[0][0] for _ in range(round(when * 500))]
    velocity = float(stepper.state[1][0])
    stepper.change_goal([goal])
    return np.array([path[-1], *(stepper.step(0.002)[0][0] for _ in range(1250))]), velocity


MOVING = {  # largest overshoot in the conventions lund and ijspeert
    "shift": ({"goal_forcing": "shift"}, 0.0029, 0.031),
    "scale": ({}, 0.0042, 0.033),
    "filter": ({"goal_rate": 12.5}, 0.0235, 0.122),
}
CHANGES = list(product((0.2, 0.4, 0.6, 0.8), (0.3, 0.6, 0.8, 1.2, 1.5)))  # when, and to which goal


@pytest.mark.parametrize("kind", MOVING)
@pytest.mark.parametrize("convention", ["lund", "ijspeert"])
def test_goals_that_move_are_hardly_overshot(convention: str, kind: str) -> None:
    t = np.linspace(0, 1, 1001)
    y = 10 * t**3 - 15 * t**4 + 6 * t**5
    dmp = fit_dmp(t, y, convention=convention).value
    limit = 1.05 * float(dmp.peak_acceleration[0])
    options, *bars = MOVING[kind]
    worst = 0.0
    for when, goal in CHANGES:
        path, v = reach(dmp, when, goal, **options)
        worst = max(worst, path.max() - max(path[0], goal))
        assert abs(path[-1] - goal) < 1e-6
        braked, _ = reach(dmp, when, goal, brake=True, **options)
        if v**2 / (2 * limit) <= goal - path[0]:
            assert braked.max() - goal <= 1e-4
        assert abs(braked[-1] - goal) < 1e-6
    assert worst <= bars[convention == "ijspeert"]


def test_a_goal_that_stays_is_not_braked_for() -> None:
    t = np.linspace(0, 1, 1001)
    dmp = fit_dmp(t, 10 * t**3 - 15 * t**4 + 6 * t**5).value
    plain, braked = dmp.stepper(), dmp.stepper(brake=True, goal_rate=12.5)
    paths = np.array([[plain.step(0.004)[0], braked.step(0.004)[0]] for _ in range(500)])
    np.testing.assert_allclose(paths[:, 0], paths[:, 1], rtol=0, atol=1e-12)
    t = np.linspace(0, 1, 101)
    assert not fit_dmp(t, np.sin(5 * t)).value.monotone.any()


def test_brakes_are_for_coordinates_that_never_turned_and_forgotten_by_a_reset(primitive: Primitive) -> None:
    """After a change of goal ``v^2 <= 2 a |goal - y|``, a 1.05 times the largest acceleration of the demonstration."""
    dmp = primitive(monotone=np.array([True, False, True]), peak_acceleration=np.full(3, 0.5), v0=np.zeros(3))
    free, braked = dmp.stepper(), dmp.stepper(brake=True)
    goal = dmp.g + 2.0
    for stepper in (free, braked):
        stepper.change_goal(goal)
    left, fast, apart = [], [], []
    for _ in range(400):
        (y, v, _), (y_free, _, _) = braked.step(0.004), free.step(0.004)
        left.append(np.abs(goal - y))
        fast.append(v)
        apart.append(np.abs(y[1] - y_free[1]))
    ahead = (np.array(fast) > 0)[:, [0, 2]]
    share = (np.array(fast) ** 2 / (2 * 1.05 * 0.5 * np.array(left)))[:, [0, 2]][ahead]
    assert 1.0 - 1e-9 <= share.max() <= 1.0 + 1e-9
    assert max(apart) == 0.0
    braked.reset()
    np.testing.assert_array_equal(braked.goal, dmp.g)


@pytest.mark.parametrize("schedule", ["canonical", "time", "position"])
def test_a_filtered_goal_is_approached_by_its_law(primitive: Primitive, schedule: str) -> None:
    """``g' = rate (goal - g) / tau``, and the forcing is scaled by it; against an adaptive solution."""
    dmp = primitive(schedule)
    weights = dmp.weights if schedule != "position" else -20 * (dmp.g - dmp.y0) * np.linspace(1, 0.5, 20)[:, None]
    dmp = replace(dmp, weights=weights, v0=np.zeros(3))
    stepper, h, rate = dmp.stepper(duration=2.4, goal_rate=4.0), 0.002, 4.0
    for _ in range(100):
        y, yd, _ = stepper.step(h)
    goal, tau = dmp.g + np.array([0.4, -0.3, 0.2]), 2.4 * dmp.tau_d / dmp.duration
    way, stiffness = dmp.g - dmp.y0, dmp.alpha_z * dmp.beta_z

    def slope(t: float, state: np.ndarray) -> np.ndarray:
        y, z, g = state.reshape(3, 3)
        x = np.clip((g - y) / (g - dmp.y0), 0, 1) if schedule == "position" else dmp.phase(100 * h + t, tau)
        f = (g - dmp.y0) / way * dmp.forcing(x)
        return np.concatenate([z, stiffness * (g - y) - dmp.alpha_z * z + f, rate * (goal - g)]) / tau

    stepper.change_goal(goal)
    rows = [stepper.step(h) for _ in range(300)]
    found = solve_ivp(slope, (0, 0.6), np.concatenate([y, tau * yd, dmp.g]), "DOP853", rtol=1e-9, atol=1e-11)
    y, z, _ = found.y[:, -1].reshape(3, 3)
    np.testing.assert_allclose(rows[-1][0], y, rtol=0, atol=1e-6)
    np.testing.assert_allclose(rows[-1][1], z / tau, rtol=0, atol=1e-5)
    np.testing.assert_allclose(rows[-1][2], slope(0.6, found.y[:, -1])[3:6] / tau, rtol=0, atol=1e-4)


def test_brakes_only_where_the_motion_can_still_be_stopped_and_says_how_it_slows(primitive: Primitive) -> None:
    """All move at 1 per s: 0.3 ahead of the goal the limit would do, 0.05 ahead it would not, and the third moves away
    from its goal."""
    way = np.array([0.3, 0.05, -0.5])
    parts = {"y0": np.zeros(3), "v0": np.ones(3), "g": np.ones(3), "peak_acceleration": np.full(3, 2.0)}
    dmp = primitive(scaling="none", weights=np.tile([100.0, 100.0, -100.0], (20, 1)), **parts)
    limit = 1.05 * 2.0
    free, braked = dmp.stepper(), dmp.stepper(brake=True)
    for stepper in (free, braked):
        stepper.change_goal(way)
    rows, other = ([stepper.step(5e-4) for _ in range(2400)] for stepper in (braked, free))
    (y, yd, ydd), (y_free, _, ydd_free) = (np.array(part).swapaxes(0, 1) for part in (rows, other))
    np.testing.assert_array_equal(y[:, 1:], y_free[:, 1:])
    np.testing.assert_array_equal(ydd[:, 1:], ydd_free[:, 1:])
    slowing, there = (ydd[:, 0] == -limit), (y[:, 0] == 0.3)
    assert slowing.sum() > 100
    assert there.any()
    fast = slowing & (yd[:, 0] > 0.5)  # the slower, the more a step of 0.5 ms is for it
    np.testing.assert_allclose(np.gradient(yd[:, 0], 5e-4)[fast][5:-5], -limit, rtol=0.1)
    np.testing.assert_array_equal(ydd[there, 0], 0.0)
    assert y[:, 0].max() == 0.3
