"""A record of a simulated arm: what the sensors report, with the time stamps and the losses that were asked for."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import identify, robots
from armlab.errors import ConfigError, ShapeError
from armlab.sim.arm.arm import SimulatedArm, record
from armlab.sim.arm.mismatch import Mismatch
from armlab.sim.arm.truth import synthetic_truth

ROBOT = robots.load("yumi_left")
TRUTH = synthetic_truth(ROBOT)
T = 0.004032
SWAY = identify.dither(ROBOT.q_home, 2.0)


def arm(**knobs: float) -> SimulatedArm:
    return SimulatedArm(ROBOT, TRUTH, seed=1, mismatch=Mismatch(**knobs))  # type: ignore[arg-type]


def test_a_record_follows_the_motion() -> None:
    table = record(arm(), SWAY)
    assert len(table) == int(2.0 / T)
    np.testing.assert_allclose(np.diff(table.t), T, rtol=1e-9)
    np.testing.assert_allclose(table["q"], SWAY.sample(table.t)[0], atol=2e-3)
    np.testing.assert_array_equal(record(arm(), SWAY)["tau"], table["tau"])
    assert "wrench_true" not in table


def test_a_push_is_in_the_torques() -> None:
    force = np.array([0, 0, -5.0, 0, 0, 0])
    pushed = record(arm(), SWAY, lambda t: np.outer(t > 1.0, force))
    np.testing.assert_array_equal(pushed["wrench_true"][-1], force)
    J = ROBOT.chain.jacobian(pushed["q"][-1])
    change = (pushed["tau"] - record(arm(), SWAY)["tau"])[-100:].mean(axis=0)
    np.testing.assert_allclose(change, -J.T @ force, atol=0.5)


def test_stamps_jitter_and_samples_are_lost() -> None:
    table = record(arm(jitter=1e-3), SWAY)
    plain = record(arm(), SWAY)
    np.testing.assert_array_equal(table["tau"], plain["tau"])
    error = table.t - plain.t
    assert 0.9e-3 < np.abs(error).max() <= 1e-3
    lossy = record(arm(lost=0.1), SWAY)
    assert 0.85 * len(plain) < len(lossy) < 0.95 * len(plain)
    assert np.isin(lossy.t, plain.t).all()


def test_what_cannot_be_recorded_is_refused() -> None:
    with pytest.raises(ConfigError, match="jitter"):
        record(arm(jitter=0.003), SWAY)
    with pytest.raises(ShapeError, match="7 joints"):
        record(arm(), identify.dither(np.zeros(6), 2.0))
    with pytest.raises(ShapeError, match="wrench"):
        record(arm(), SWAY, lambda t: np.zeros((3, 6)))
