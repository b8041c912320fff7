"""Velocity and acceleration limits: met exactly on the same path, slower as a whole or only where necessary."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armlab import State, bridge, robots
from armlab.motion import Dmp, fit_dmp
from armlab.motion.dmp import DmpController
from armlab.motion.timing import PacedDmp, PacedStepper, fastest, retimed, shortest_duration

from .conftest import primitive

U = np.linspace(0.0, 1.0, 501)
S = U**3 * (10 - 15 * U + 6 * U**2)


@pytest.fixture(scope="module")
def dmp() -> Dmp:
    return fit_dmp(U, np.stack([S, 0.3 * np.sin(2 * np.pi * S)], axis=1), n_basis=20).value


@pytest.mark.parametrize("limits", [(0.5, np.inf), (np.inf, 1.5), ([0.8, 0.9], [1.0, 9.0])])
def test_limits_are_met_exactly_on_the_same_path(dmp: Dmp, limits: tuple) -> None:
    duration = shortest_duration(dmp, *limits)
    k = duration / dmp.duration
    assert k > 1.0
    t = np.linspace(0, 1.3, 9001)
    slow, run = dmp.rollout(k * t, duration=duration), dmp.rollout(t)
    np.testing.assert_allclose(slow.y, run.y, rtol=0, atol=1e-10)
    shares = [(np.abs(slow.yd) / limits[0]).max(), (np.abs(slow.ydd) / limits[1]).max()]
    assert max(shares) <= 1.0 + 1e-9
    assert max(shares) > 1.0 - 1e-5  # between samples the limit is reached


@pytest.mark.parametrize("seed", range(2))
def test_accelerations_of_many_kernels_keep_to_the_limit(seed: int) -> None:
    waves = sum(np.sin(np.pi * k * U + phase) for k, phase in enumerate(np.random.default_rng(seed).normal(size=5)))
    dmp = fit_dmp(U, (S + waves)[:, None], n_basis=60, schedule="time", convention="ijspeert").value
    duration = shortest_duration(dmp, np.inf, 1.0)
    top = dmp.rollout(np.linspace(0.0, duration, 100_001), duration=duration).ydd
    assert 1.0 - 1e-6 <= np.abs(top).max() <= 1.0 + 1e-9


def test_slow_motion_keeps_its_duration_and_far_goals_take_longer(dmp: Dmp) -> None:
    assert shortest_duration(dmp, 100.0, 1000.0) == dmp.duration
    near, far = (shortest_duration(dmp, [0.5, 100.0], g=dmp.y0 + s * (dmp.g - dmp.y0)) for s in (1.0, 3.0))
    assert far == pytest.approx(3 * near, rel=1e-9)


TURN = 2.8 * np.pi * S
LETTER = np.stack(
    [
        0.10 * np.cos(TURN) - 0.02 * np.sin(6 * np.pi * S) + 0.06 * S,
        0.12 * np.sin(TURN + 0.4) + 0.03 * np.cos(4 * np.pi * S) - 0.05 * S,
    ],
    axis=1,
)
RAMP = np.concatenate([np.zeros(10), np.linspace(0, 2, 1000), np.full(500, 2.0)])[:, None] * [1.0, 0.5]
DEMOS = {
    "minimum jerk": (U, S[:, None]),
    "letter": (U, LETTER),
    "ramp": (np.linspace(0, 10, 1510), RAMP),
    "noise": (np.linspace(0, 10, 1510), RAMP + 1e-3 * np.random.default_rng(0).standard_normal(RAMP.shape)),
}
TOLERANCE = 1e-6  # of the limits


def check(dmp: Dmp, v_max: np.ndarray, a_max: np.ndarray) -> PacedDmp:
    """Check the three guarantees at times other than those at which the pace was planned."""
    paced, stretched = retimed(dmp, v_max, a_max), shortest_duration(dmp, v_max, a_max)
    assert dmp.duration * (1 - 1e-12) <= paced.duration <= stretched * (1 + 1e-12)
    t = np.linspace(0.0, paced.t[-1], 10_007)
    run = paced.rollout(t)
    assert (np.abs(run.yd) <= v_max * (1 + TOLERANCE)).all()
    assert (np.abs(run.ydd) <= a_max * (1 + TOLERANCE)).all()
    s, rate, _ = paced._clock(t)
    assert ((np.diff(s) > 0.0) & (rate[1:] <= 1.0)).all()
    whole = dmp.rollout(np.union1d(s, np.linspace(0.0, s[-1], 20_001)))
    size = np.abs(whole.y).max()
    np.testing.assert_allclose(run.y, whole.y[np.searchsorted(whole.t, s)], rtol=0, atol=1e-9 * size)
    mean = 0.5 * (run.yd[1:] + run.yd[:-1])  # and the velocity is that of the positions
    assert (np.abs(np.diff(run.y, axis=0) / t[1] - mean) <= 0.5 * t[1] * np.abs(run.ydd).max(axis=0) + 1e-9).all()
    return paced


def sizes(dmp: Dmp) -> tuple[np.ndarray, np.ndarray]:
    run = dmp.rollout(np.linspace(0.0, 1.5 * dmp.duration, 3001))
    return np.abs(run.yd).max(axis=0), np.abs(run.ydd).max(axis=0)


@pytest.mark.parametrize("demo", DEMOS)
def test_demonstrations(demo: str) -> None:
    dmp = fit_dmp(*DEMOS[demo]).value
    v, a = sizes(dmp)
    paced = check(dmp, 0.6 * v, 0.3 * a)
    assert paced.duration < 0.85 * shortest_duration(dmp, 0.6 * v, 0.3 * a)  # and much sooner


@given(st.integers(0, 999), st.sampled_from([0.02, 0.4, 1.2]), st.sampled_from([0.01, 0.3, np.inf]))
@settings(max_examples=3)
def test_random_primitives(seed: int, fast: float, hard: float) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 8))
    dmp = primitive(n=n, weights=60 * rng.normal(size=(20, n)), scaling="none")
    v, a = sizes(dmp)
    check(dmp, fast * v * rng.uniform(0.5, 2, n), hard * a * rng.uniform(0.5, 2, n))


def test_least_time_of_a_straight_line() -> None:
    """Cases solved by hand: constant velocity, and y = s^2 from rest under an acceleration limit."""
    s = np.linspace(0.0, 1.0, 2001)
    y_s = (1.0 + 0.0 * s)[:, None]
    z = fastest(s[1], y_s, 0.0 * y_s, np.array([0.5]), np.array([1.0]))
    np.testing.assert_allclose(z, 0.25, rtol=1e-12)  # the velocity limit
    bend = 2.0 + 0.0 * y_s  # y = s^2: y_s = 2 s, so y'' <= 1 from rest means s'^2 = t^2 / 2 / s^2 = 1 / 2
    z = fastest(s[1], 2 * s[:, None], bend, np.array([np.inf]), np.array([1.0]))
    np.testing.assert_allclose(z[1:], 0.5, rtol=1e-9)


def test_wide_limits_change_nothing() -> None:
    dmp = fit_dmp(U, LETTER, n_basis=20).value
    paced = retimed(dmp, 100.0, 1e4)
    assert paced.duration == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(paced.rollout(0.004).y, dmp.rollout(0.004).y, rtol=0, atol=1e-7)  # of steps of 4 ms
    assert len(paced.rollout(0.004).t) == 251


def test_steps_are_the_rollout_and_far_goals_take_longer() -> None:
    dmp = fit_dmp(U, LETTER, n_basis=20).value
    limits = (0.5, 10.0)
    paced, far = (retimed(dmp, *limits, g=dmp.y0 + k * (dmp.g - dmp.y0)) for k in (1.0, 2.0))
    assert far.duration > 1.2 * paced.duration
    run, stepper = paced.rollout(0.004), paced.stepper()
    assert isinstance(stepper, PacedStepper)
    steps = [stepper.state, *(stepper.step(0.004) for _ in run.t[1:])]
    for k, (part, atol) in enumerate(((run.y, 1e-7), (run.yd, 2e-6), (run.ydd, 1e-4))):  # of steps of 4 ms
        np.testing.assert_allclose(np.array(steps)[:, k], part, rtol=0, atol=atol)
    assert (stepper.t, stepper.duration) == (pytest.approx(run.t[-1]), paced.duration)
    stepper.reset()
    np.testing.assert_array_equal(stepper.state, steps[0])


def test_the_controller_is_not_limited_at_250_hz() -> None:
    """A motion planned within 0.95 of the limits is never clamped; the same motion as demonstrated is."""
    robot = robots.load("yumi_right")
    q = robot.q_home + S[:, None] * np.array([1.1, 0.1, 0.2, 0.2, -0.3, 0.4, 0.2])
    dmp = fit_dmp(0.5 * U, q, n_basis=20, scaling="none").value
    limits = bridge.Limits.of(robot, speed=0.4)
    paced = retimed(dmp, 0.95 * limits.qd_max, 0.95 * limits.qdd_max, v0=np.zeros(7))
    for motion, wanted in ((paced, False), (dmp, True)):
        controller = motion.controller(robot, limits=limits)
        assert isinstance(controller, DmpController)
        now, cut = q[0], False
        for k in range(round((motion.duration + 1.0) / 0.004)):
            command = controller(State(0.004 * k, 0.004, now, np.zeros(7), now))
            now, cut = command.q, cut or bool(controller.clamped.any())
        assert cut == wanted
        assert controller.done == (not wanted)  # clamped motion is not made up for
