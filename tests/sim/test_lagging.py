"""The arm without masses: dead time, lag, no torques."""

from __future__ import annotations

import numpy as np

from armlab import robots
from armlab.sim.arm.arm import LaggingArm

ROBOT = robots.load("ur5e")


def test_a_step_comes_after_two_cycles_through_a_lag_of_8_ms() -> None:
    arm = LaggingArm(ROBOT, 0.004)
    goal, seen = ROBOT.q_home + 0.1, []
    for _ in range(12):
        arm.step(goal, np.zeros(6), None)
        seen.append(arm.measure().q - ROBOT.q_home)
    expected = np.where(np.arange(12) < 2, 0.0, 0.1 * (1 - np.exp(-0.004 * (np.arange(12) - 1) / 0.008)))
    np.testing.assert_allclose(np.array(seen)[:, 0], expected, atol=1e-12)
    measured = arm.measure()
    assert np.isnan(measured.tau).all()
    assert not arm.has_torque
    np.testing.assert_allclose(arm.sample.T_base_tool, ROBOT.chain.forward(measured.q))


def test_velocity_is_that_of_the_motion() -> None:
    arm = LaggingArm(ROBOT)
    before = arm.measure().q
    for k in range(200):
        arm.step(ROBOT.q_home + 0.1 * 0.004032 * k, np.full(6, 0.1), None)
        if k == 198:
            before = arm.measure().q
    np.testing.assert_allclose((arm.measure().q - before) / 0.004032, arm.measure().qd, atol=1e-12)
    np.testing.assert_allclose(arm.measure().qd, 0.1, rtol=1e-6)
    arm.place(ROBOT.q_home)
    np.testing.assert_array_equal(arm.sample.qd, 0.0)
