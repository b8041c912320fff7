"""Rhythmic primitives: invariances, fits, sample-by-sample runs, and an arm that starts and ends at rest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab import robots
from armlab.errors import NotExcited
from armlab.estimation import Experiment, Gauge, check_estimator
from armlab.motion import PeriodicDmp, fit_periodic_dmp
from armlab.motion.periodic import PeriodicController, PeriodicStepper

from .conftest import arm

M = 15
CLOCK = np.linspace(0.0, 6.0, 1501)


@pytest.fixture(scope="module")
def dmp() -> PeriodicDmp:
    rng = np.random.default_rng(0)
    centres = 2 * np.pi / M * np.arange(M)
    return PeriodicDmp(100 * rng.normal(size=(M, 2)), centres, (M / (2 * np.pi)) ** 2, 2.0, np.array([0.5, -0.2]))


def test_amplitude_scales_the_motion_around_the_baseline(dmp: PeriodicDmp) -> None:
    once, twice = dmp.rollout(CLOCK), dmp.rollout(CLOCK, r=2.0)
    np.testing.assert_allclose(twice.y - dmp.g, 2 * (once.y - dmp.g), rtol=0, atol=1e-10)
    moved = dmp.rollout(CLOCK, g=[1.5, 0.0])
    np.testing.assert_allclose(moved.y, once.y + np.array([1.0, 0.2]), rtol=0, atol=1e-10)


def test_the_motion_repeats_itself_and_does_not_jump_at_the_wrap(dmp: PeriodicDmp) -> None:
    run = dmp.rollout(CLOCK)
    for values in (run.y, run.yd, run.ydd):
        np.testing.assert_allclose(values[1000:], values[500:-500], rtol=0, atol=1e-8 * np.abs(values).max())
    np.testing.assert_allclose(run.x, np.pi * CLOCK, atol=1e-12)
    near = dmp.rollout(np.array([0.0, 1.999, 2.0, 2.001]))
    assert np.abs(np.diff(near.y[1:], axis=0)).max() < 0.002 * np.abs(run.yd).max()


def test_another_period_is_another_clock(dmp: PeriodicDmp) -> None:
    once, slow = dmp.rollout(CLOCK), dmp.rollout(3 * CLOCK, period=6.0)
    np.testing.assert_allclose(slow.y, once.y, rtol=0, atol=1e-10)
    np.testing.assert_allclose(3 * slow.yd, once.yd, rtol=0, atol=1e-9)
    assert dmp.rollout(0.1, period=4.0).t[-1] == pytest.approx(4.0)


def test_it_starts_anywhere_and_at_any_phase(dmp: PeriodicDmp) -> None:
    whole, half = dmp.rollout(CLOCK), dmp.rollout(CLOCK[:501], phase=np.pi)
    np.testing.assert_allclose(half.y, whole.y[250:751], rtol=0, atol=1e-8)
    y, rate = dmp.steady(whole.x)
    np.testing.assert_allclose(dmp.g + y, whole.y, rtol=0, atol=1e-7)
    np.testing.assert_allclose(rate * np.pi, whole.yd, rtol=0, atol=1e-6)
    away = dmp.rollout(CLOCK, y0=[3.0, 3.0], v0=[0.0, 0.0])
    np.testing.assert_array_equal(away.y[0], [3.0, 3.0])
    np.testing.assert_allclose(away.y[-1], whole.y[-1], atol=1e-6)


TURN = 2.0
T = np.linspace(0.0, 2 * TURN, 1001)


def wave(t: np.ndarray) -> np.ndarray:
    phi = 2 * np.pi * t / TURN
    return np.stack([np.sin(phi) + 0.4 * np.sin(3 * phi + 0.5), 0.3 + 0.1 * np.cos(phi)], axis=1)


def test_the_steady_motion_is_the_demonstration() -> None:
    fit = fit_periodic_dmp(T, wave(T), period=TURN)
    run = fit.value.rollout(T)
    size = np.ptp(wave(T), axis=0)
    assert (np.sqrt(((run.y - wave(T)) ** 2).mean(axis=0)) / size).max() < 1e-6
    assert (np.sqrt((fit.residuals**2).mean(axis=0)) / size).max() < 1e-6
    late = fit.value.rollout(T, y0=[2.0, -1.0], v0=[0.0, 0.0])
    np.testing.assert_allclose(late.y[500:], wave(T)[500:], atol=2e-6)


def test_a_shifted_clock_changes_nothing_and_other_harmonics_come_in_h() -> None:
    one, other = (fit_periodic_dmp(T + shift, wave(T), period=TURN) for shift in (0.0, 5.0))
    np.testing.assert_allclose(other.value.rollout(T).y, one.value.rollout(T).y, atol=1e-9)
    wide = fit_periodic_dmp(T, wave(T), period=TURN, h=4.0, n_basis=9, g=[0.0, 0.3])
    assert wide.value.h == 4.0
    np.testing.assert_array_equal(wide.value.g, [0.0, 0.3])


TRUTH = fit_periodic_dmp(T, wave(T)[:, :1], period=TURN, n_basis=6, h=0.5, g=[0.0]).value


def drawn(seed: int, n: int) -> Experiment:
    t = np.linspace(0.0, 5 * TURN, n)
    y = TRUTH.rollout(t).y + 0.01 * np.random.default_rng([4, seed]).normal(size=(n, 1))
    data = {"t": t, "y": y, "period": TURN, "n_basis": 6, "h": 0.5, "g": np.zeros(1)}
    return Experiment(data, TRUTH.weights.T.ravel())


def test_the_fit_meets_the_contract() -> None:
    contract = check_estimator(
        fit_periodic_dmp,
        drawn,
        25,
        n=150,
        noise_given=False,
        gauges=[Gauge("millimetres", lambda d: {**d, "y": 1e3 * d["y"]}, lambda fit: 1e3 * fit.parameters)],
        skip={
            "efficient": "judged from 1000 runs on",
            "order-free": "samples are a motion in time",
            "refuses": "a test of its own: periods that were seen in part",
            "robust": "a motion has no outliers that could be told from it",
        },
    )
    assert contract.passed, contract.text()


def test_a_ridge_makes_weights_smaller() -> None:
    free, held = (fit_periodic_dmp(T, wave(T), period=TURN, ridge=ridge).value for ridge in (0.0, 1e-3))
    assert np.linalg.norm(held.weights) < np.linalg.norm(free.weights)
    assert isinstance(replace(held, period=1.0), PeriodicDmp)


@pytest.mark.parametrize("share", [0.3, 0.5, 0.7])
def test_a_period_seen_in_part_is_refused_by_what_is_missing(share: float) -> None:
    """The motion would be off by 1e12, 7e7 and 29 times its size where there are no samples."""
    t = np.linspace(0.0, share * TURN, 500)
    with pytest.raises(NotExcited, match=rf"from {share:.2g} to 1 of the period.*ridge") as refused:
        fit_periodic_dmp(t, wave(t), period=TURN)
    assert refused.value.directions
    held = fit_periodic_dmp(t, wave(t), period=TURN, ridge=1e-8)
    assert np.abs(held.value.rollout(np.linspace(0.0, TURN, 100)).y).max() < 10.0


def test_samples_at_few_places_of_many_periods_are_refused() -> None:
    t = TURN / 4 * np.arange(200)
    with pytest.raises(NotExcited, match="21 of 25 weights undetermined"):
        fit_periodic_dmp(t, wave(t), period=TURN)
    t = 1.01 * t
    assert fit_periodic_dmp(t, wave(t), period=TURN).excitation.condition < 1e3


TICKS = np.linspace(0.0, 2.0, 501)
SINE = fit_periodic_dmp(TICKS, np.sin(np.pi * TICKS)[:, None], period=2.0).value


def test_steps_are_the_rollout() -> None:
    t = np.cumsum(np.random.default_rng(0).uniform(0.001, 0.006, 200))
    run, stepper = SINE.rollout(t, r=0.5, phase=1.0), SINE.stepper(r=0.5, phase=1.0)
    assert isinstance(stepper, PeriodicStepper)
    for _ in range(2):
        rows = [stepper.state, *(stepper.step(dt) for dt in np.diff(t))]
        for own, wanted in zip(map(np.array, zip(*rows)), (run.y, run.yd, run.ydd)):
            np.testing.assert_allclose(own, wanted, rtol=0, atol=1e-12 * (1 + np.abs(wanted).max()))
        assert stepper.phase == pytest.approx(run.x[-1])
        stepper.reset()


def test_baseline_amplitude_and_period_change_without_a_jump() -> None:
    stepper = SINE.stepper()
    for _ in range(100):
        y, yd, _ = stepper.step(0.004)
    stepper.change(g=[2.0], r=0.3, period=1.0)
    np.testing.assert_allclose(stepper.state[0], y, rtol=1e-12)
    np.testing.assert_allclose(stepper.state[1], yd, rtol=1e-12)
    late = np.array([stepper.step(0.002)[0][0] for _ in range(1500)])[-500:]
    assert late.max() == pytest.approx(2.3, abs=1e-3)
    assert late.min() == pytest.approx(1.7, abs=1e-3)


def test_what_a_change_leaves_out_stays() -> None:
    """Amplitude, baseline and period are changed in turn: the others stay as before."""
    stepper, turn = SINE.stepper(g=[1.0], r=0.5, period=1.6), 2 * np.pi * 0.004
    stepper.step(0.004)
    for change, period, wanted in (
        ({"r": 0.8}, 1.6, (0.2, 1.8)),
        ({"g": [3.0]}, 1.6, (2.2, 3.8)),
        ({"period": 1.2}, 1.2, (2.2, 3.8)),
        ({}, 1.2, (2.2, 3.8)),
    ):
        before, speed = stepper.phase, stepper.state[1]
        stepper.change(**change)
        np.testing.assert_allclose(stepper.state[1], speed, rtol=1e-12)
        y = np.array([stepper.step(0.004)[0][0] for _ in range(900)])
        assert stepper.phase - before == pytest.approx(900 * turn / period, rel=1e-12)
        np.testing.assert_allclose([y[-400:].min(), y[-400:].max()], wanted, rtol=0, atol=2e-3)


CYCLE = 0.004032
ROBOT = robots.load("yumi_right")
SECONDS = np.linspace(0.0, 4.0, 401)


@pytest.fixture(scope="module")
def rhythm() -> PeriodicDmp:
    """Two joints complete two cycles in four seconds."""
    y = np.tile(ROBOT.q_home, (401, 1))
    y[:, 0] += 0.2 * np.cos(np.pi * SECONDS)
    y[:, 1] += 0.1 * np.sin(np.pi * SECONDS)
    return fit_periodic_dmp(SECONDS, y, period=2.0).value


def test_it_grows_goes_round_and_fades(rhythm: PeriodicDmp) -> None:
    controller = rhythm.controller(ROBOT, turns=4.0)
    assert isinstance(controller, PeriodicController)
    q, _ = arm().run(controller, 9.0)
    t = CYCLE * np.arange(len(q))
    assert np.abs(q[0] - ROBOT.q_home).max() < 1e-9
    assert np.abs(np.diff(q, axis=0)).max() / CYCLE < 1.2 * 0.2 * np.pi  # never faster than demonstrated
    full = (t > 3.0) & (t < 5.8)
    wanted = rhythm.g + rhythm.steady(2 * np.pi * t[full] / 2.0)[0]
    np.testing.assert_allclose(q[full], wanted, rtol=0, atol=2e-3)
    assert np.abs(q[-1] - rhythm.g).max() < 1e-3
    assert controller.done


def test_amplitude_period_and_baseline_are_free(rhythm: PeriodicDmp) -> None:
    there = rhythm.g + 0.05
    q, _ = arm().run(rhythm.controller(ROBOT, period=1.0, r=0.5, g=there), 3.0)
    last = q[-round(1.0 / CYCLE) :]
    np.testing.assert_allclose(np.ptp(last[:, :2], axis=0), [0.2, 0.1], rtol=0.01)
    np.testing.assert_allclose(last.mean(axis=0), there, rtol=0, atol=2e-3)
