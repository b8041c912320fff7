"""The drive's law, its integral and its saturation."""

from __future__ import annotations

import numpy as np

from armlab.sim.arm.drive import INTEGRAL_TIME, POSITION_GAIN, VELOCITY_GAIN, JointDrives

INERTIA, TAU_MAX = np.array([0.2, 0.1]), np.array([40.0, 5.0])
ZERO = np.zeros(2)


def drive() -> JointDrives:
    return JointDrives(INERTIA, TAU_MAX, np.array([0.9, 0.9]), 1e-3)


def test_law_without_integral() -> None:
    error = np.array([1e-4, -2e-4])
    speed = np.array([0.01, 0.02])
    e = POSITION_GAIN * error + speed
    expected = INERTIA * (3.0 + VELOCITY_GAIN * (e + e * 1e-3 / INTEGRAL_TIME)) + 0.9 * np.array([2.0, 1.0])
    tau = drive().torque(error, speed, np.full(2, 3.0), ZERO, ZERO, np.array([2.0, 1.0]), np.empty(2))
    np.testing.assert_allclose(tau, expected, rtol=1e-12)


def test_reset_holds() -> None:
    unit, holding, bias = drive(), np.array([7.0, -1.0]), np.array([6.0, 0.5])
    unit.reset(holding, bias)
    np.testing.assert_allclose(unit.torque(ZERO, ZERO, ZERO, ZERO, ZERO, bias, np.empty(2)), holding, rtol=1e-12)
    np.testing.assert_allclose(unit.gravity, 0.9 * bias)


def test_saturation_stops_the_integral() -> None:
    unit, far = drive(), np.array([0.0, 1.0])
    for _ in range(1000):
        tau = unit.torque(far, ZERO, ZERO, ZERO, ZERO, ZERO, np.empty(2))
    assert tau[1] == TAU_MAX[1]
    assert unit.saturated == 1000
    back = unit.torque(ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, np.empty(2))
    np.testing.assert_allclose(back, 0.0, atol=1e-9)


def test_integral_removes_a_constant_load() -> None:
    """A free mass under a constant load returns to its reference."""
    unit, q, qd, load = drive(), np.zeros(2), np.zeros(2), np.array([-3.0, 1.0])
    largest = np.zeros(2)
    for _ in range(3000):
        tau = unit.torque(ZERO, ZERO, ZERO, q, qd, ZERO, np.empty(2))
        qd += 1e-3 * (tau + load) / INERTIA
        q += 1e-3 * qd
        largest = np.maximum(largest, np.abs(q))
    assert (largest > 1e-4).all()
    np.testing.assert_allclose(q, 0.0, atol=1e-9)
    np.testing.assert_allclose(tau, -load, rtol=1e-6)


def test_scaled_gains_and_added_torque_follow_the_law() -> None:
    unit = drive()
    unit.assist(np.array([0.5, -0.2]), np.array([0.5, 0.0]), np.array([2.0, 0.0]))
    lag, speed, bias = np.array([1e-3, 2e-3]), np.array([0.01, 0.02]), np.array([2.0, 1.0])
    e = np.array([2.0, 0.0]) * speed + np.array([0.5, 0.0]) * POSITION_GAIN * lag
    integral = np.array([0.5, 0.0]) ** 2 * e * 1e-3 / INTEGRAL_TIME
    expected = INERTIA * (np.array([2.0, 0.0]) * 3.0 + VELOCITY_GAIN * (e + integral)) + 0.9 * bias + [0.5, -0.2]
    tau = unit.torque(lag, speed, np.full(2, 3.0), ZERO, ZERO, bias, np.empty(2))
    np.testing.assert_allclose(tau, expected, rtol=1e-12)
    assert tau[1] == 0.9 * 1.0 - 0.2, "both scales zero: feed-forward and the added torque alone"


def test_alone_again_it_is_the_plain_drive_bit_for_bit() -> None:
    plain, used = drive(), drive()
    used.assist(np.ones(2), np.zeros(2), np.zeros(2))
    used.alone()
    step = (np.array([1e-4, -2e-4]), np.array([0.01, 0.02]), np.full(2, 3.0), ZERO, ZERO, np.array([2.0, 1.0]))
    for _ in range(3):
        np.testing.assert_array_equal(used.torque(*step, np.empty(2)), plain.torque(*step, np.empty(2)))
