"""What is reported of an instant: delay, elastic gears, and a sentence before there was one."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import robots
from armlab.errors import ConfigError
from armlab.sim.arm.arm import SimulatedArm
from armlab.sim.arm.mismatch import Mismatch
from armlab.sim.arm.sensors import SensorReading, Sensors
from armlab.sim.arm.truth import synthetic_truth

ROBOT = robots.load("yumi_left")
TRUTH = synthetic_truth(ROBOT).without("noise")
T = 0.004032


def walk(arm: SimulatedArm, k: int) -> None:
    arm.step(ROBOT.q_home + 0.1 * (1 - np.cos(3 * k * T)), np.full(7, 0.3 * np.sin(3 * k * T)), None)


def test_torque_comes_late_and_position_does_not() -> None:
    arm = SimulatedArm(ROBOT, TRUTH, mismatch=Mismatch(torque_delay=3))
    exact = [arm.sample.tau]
    for k in range(1, 30):
        walk(arm, k)
        exact.append(arm.sample.tau)
        measured = arm.measure()
        np.testing.assert_array_equal(measured.tau, exact[max(k - 3, 0)])
        np.testing.assert_array_equal(measured.q, arm.sample.q)


def test_an_elastic_gear_turns_by_what_it_carries() -> None:
    """At rest it carries gravity; a velocity is the derivative of the position that is reported."""
    arm = SimulatedArm(ROBOT, TRUTH, mismatch=Mismatch(elasticity=1e-2))
    carried = ROBOT.chain.rnea(arm.sample.q, np.zeros(7), np.zeros(7), ROBOT.gravity, TRUTH.pi)
    np.testing.assert_allclose(arm.measure().q - arm.sample.q, 1e-2 * carried / TRUTH.tau_max, atol=1e-6)
    rows = []
    for k in range(1, 200):
        walk(arm, k)
        measured = arm.measure()
        rows.append((measured.q, measured.qd))
    q, qd = np.array(rows).transpose(1, 0, 2)
    np.testing.assert_allclose(np.diff(q, axis=0)[20:] / T, 0.5 * (qd[1:] + qd[:-1])[20:], atol=2e-3)


def test_nothing_seen_nothing_measured() -> None:
    sensors = Sensors(TRUTH, Mismatch(), T, 0)
    with pytest.raises(ConfigError, match="instant"):
        sensors.measure()
    arm = SimulatedArm(ROBOT, TRUTH)
    sensors.see(arm.sample)
    measured = sensors.measure()
    assert isinstance(measured, SensorReading)
    np.testing.assert_array_equal(measured.tau, arm.sample.tau)
    sensors.reset()
    with pytest.raises(ConfigError, match="instant"):
        sensors.measure()
