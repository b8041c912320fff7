"""Rhythmic motion sample by sample: the numbers of the rollout, and changes on the way."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.errors import ShapeError
from armlab.motion import PeriodicStepper, fit_periodic_dmp

T = np.linspace(0.0, 2.0, 501)
DMP = fit_periodic_dmp(T, np.sin(np.pi * T)[:, None], period=2.0).value


def test_steps_are_the_rollout() -> None:
    t = np.cumsum(np.random.default_rng(0).uniform(0.001, 0.006, 200))
    run, stepper = DMP.rollout(t, r=0.5, phase=1.0), DMP.stepper(r=0.5, phase=1.0)
    assert isinstance(stepper, PeriodicStepper)
    for _ in range(2):
        rows = [stepper.state, *(stepper.step(dt) for dt in np.diff(t))]
        for own, wanted in zip(map(np.array, zip(*rows)), (run.y, run.yd, run.ydd)):
            np.testing.assert_allclose(own, wanted, rtol=0, atol=1e-12 * (1 + np.abs(wanted).max()))
        assert stepper.phase == pytest.approx(run.x[-1])
        stepper.reset()


def test_baseline_amplitude_and_period_change_without_a_jump() -> None:
    stepper = DMP.stepper()
    for _ in range(100):
        y, yd, _ = stepper.step(0.004)
    stepper.change(g=[2.0], r=0.3, period=1.0)
    np.testing.assert_allclose(stepper.state[0], y, rtol=1e-12)
    np.testing.assert_allclose(stepper.state[1], yd, rtol=1e-12)
    late = np.array([stepper.step(0.002)[0][0] for _ in range(1500)])[-500:]
    assert late.max() == pytest.approx(2.3, abs=1e-3)
    assert late.min() == pytest.approx(1.7, abs=1e-3)


def test_what_a_change_leaves_out_stays() -> None:
    """In turn the amplitude, the baseline and the period: the others are those of before."""
    stepper, turn = DMP.stepper(g=[1.0], r=0.5, period=1.6), 2 * np.pi * 0.004
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


def test_refusals() -> None:
    stepper = DMP.stepper()
    for words, call in {
        "dt above zero": lambda: stepper.step(0.0),
        "period above zero": lambda: stepper.change(period=0.0),
        "finite r": lambda: stepper.change(r=np.nan),
        "g with 1": lambda: stepper.change(g=[0.0, 1.0]),
    }.items():
        with pytest.raises(ShapeError, match=words):
            call()
