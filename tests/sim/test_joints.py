"""Friction and drives of the simulated joints."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import robots
from armlab.sim.arm.joints import (
    INTEGRAL_TIME,
    POSITION_GAIN,
    VELOCITY_GAIN,
    WARM_TIME,
    JointDrives,
    JointFriction,
    WornFriction,
)
from armlab.sim.arm.mismatch import Mismatch
from armlab.sim.arm.truth import Truth, synthetic_truth

STEP = 1e-3


@pytest.fixture
def truth() -> Truth:
    return synthetic_truth(robots.load("yumi_left")).without("ripple", "offset")


def slide(friction: JointFriction, speed: float, distance: float) -> np.ndarray:
    """Move all joints at one speed; return the friction torque at the end."""
    qd = np.full(7, speed)
    for _ in range(max(1, round(distance / abs(speed) / STEP))):
        friction.advance(qd * STEP, qd)
    return friction.torque(np.zeros(7), qd, np.empty(7))


@pytest.mark.parametrize("speed", [0.002, 0.02, 0.05, 0.1, 0.3, 1.0])
def test_constant_speed_gives_the_stribeck_curve(truth: Truth, speed: float) -> None:
    bump = 1 + 0.3 * np.exp(-((speed / 0.05) ** 2))
    np.testing.assert_allclose(
        slide(JointFriction(truth), speed, 0.01), truth.coulomb_pos * bump + truth.viscous * speed, rtol=1e-6
    )
    np.testing.assert_allclose(
        slide(JointFriction(truth), -speed, 0.01), -truth.coulomb_neg * bump - truth.viscous * speed, rtol=1e-6
    )


def test_break_away_is_at_static_friction(truth: Truth) -> None:
    """A slowly growing torque on a free mass: it creeps within the presliding distance, then it goes."""
    friction, inertia = JointFriction(truth), np.full(7, 0.2)
    qd, q, broke = np.zeros(7), np.zeros(7), np.full(7, np.nan)
    for share in np.linspace(0.0, 1.6, 20000):
        tau = share * truth.coulomb_pos
        qd += STEP * (tau - friction.torque(q, qd, np.empty(7))) / inertia
        q += STEP * qd
        friction.advance(STEP * qd, qd)
        moved = np.isnan(broke) & (qd > 0.02)
        broke[moved] = share
    np.testing.assert_allclose(broke, 1.3, atol=0.05)


def test_it_sticks_at_rest(truth: Truth) -> None:
    """A mass under 90 % of the static friction comes to rest within a few presliding distances and stays."""
    friction, qd, q = JointFriction(truth), np.zeros(7), np.zeros(7)
    tau, inertia = 1.17 * truth.coulomb_pos, 0.2
    damping = 10.0  # a drive's velocity gain; without one the bristle springs ring
    track = []
    for _ in range(8000):
        qd += STEP * (tau - damping * qd - friction.torque(q, qd, np.empty(7))) / inertia
        q += STEP * qd
        friction.advance(STEP * qd, qd)
        track.append(q.copy())
    assert np.abs(qd).max() < 1e-12
    assert (q < 10 * truth.delta).all()
    assert np.abs(track[-1] - track[-2000]).max() < 1e-12


def test_presliding_is_a_spring_with_hysteresis(truth: Truth) -> None:
    friction = JointFriction(truth)
    dq = np.full(7, 1e-8)
    friction.advance(dq, np.zeros(7))
    np.testing.assert_allclose(friction.bristle, truth.coulomb_pos / truth.delta * 1e-8, rtol=1e-3)
    friction.reset()
    loop = []
    for direction in (1, -1, 1):
        for _ in range(20):
            friction.advance(np.full(7, direction * 5e-6), np.zeros(7))
            loop.append(friction.bristle.copy())
    up, down, again = loop[19], loop[39], loop[59]
    assert (down < 0).all(), "the way back starts from a loaded bristle and ends below zero"
    assert (np.abs(up) > np.abs(down)).all()
    enclosed = 5e-6 * (np.sum(loop[40:60], axis=0) - np.sum(loop[20:40], axis=0))
    assert (enclosed > 0).all(), "a loop costs energy"
    assert (again < up).all()


def test_step_length_does_not_matter_at_constant_speed(truth: Truth) -> None:
    coarse, fine = JointFriction(truth), JointFriction(truth)
    qd = np.full(7, 0.05)
    coarse.advance(2e-4 * np.ones(7), qd)
    for _ in range(200):
        fine.advance(1e-6 * np.ones(7), qd)
    np.testing.assert_allclose(coarse.bristle, fine.bristle, rtol=1e-12)


def test_ripple_and_offset() -> None:
    truth = synthetic_truth(robots.load("yumi_left"))
    friction, q = JointFriction(truth), np.linspace(-1, 1, 7)
    expected = truth.offset + truth.ripple * np.sin(truth.ripple_cycles * q + np.arange(7))
    np.testing.assert_allclose(friction.torque(q, np.zeros(7), np.empty(7)), expected, rtol=1e-12)
    turn = friction.torque(q + 2 * np.pi / truth.ripple_cycles, np.zeros(7), np.empty(7))
    np.testing.assert_allclose(turn, expected, rtol=1e-9)


YUMI = robots.load("yumi_left")
WORN_TRUTH = synthetic_truth(YUMI).without("offset")


def slide_worn(friction: JointFriction, speed: np.ndarray, step: float = 0.01, count: int = 50) -> np.ndarray:
    """Torque after sliding `count` steps."""
    for _ in range(count):
        friction.advance(speed * step, speed)
    return friction.torque(np.zeros(7), speed, np.empty(7))


def test_a_warm_drive_has_lost_its_share_of_viscous_friction() -> None:
    """At a quarter of full speed the warmth settles at 1, with the time constant of 12 minutes."""
    smooth = WORN_TRUTH.without("ripple")
    speed = 0.25 * YUMI.qd_max
    friction = WornFriction(smooth, Mismatch(warm_up=0.4), 1.0, np.zeros(7))
    cold = slide_worn(JointFriction(smooth), speed, 1.0)
    slide_worn(friction, speed, 1.0, round(WARM_TIME))
    assert np.all(friction.warmth > 0.5)
    assert np.all(friction.warmth < 1 - np.exp(-1.0) + 0.01)
    warm = slide_worn(friction, speed, 1.0, 7 * round(WARM_TIME))
    assert np.all(friction.warmth > 0.9)
    lost = 0.4 * np.minimum(friction.warmth, 1.0) * smooth.viscous * speed
    np.testing.assert_allclose(cold - warm, lost, rtol=1e-3)


def test_load_presses_on_the_bearings() -> None:
    speed, smooth = np.full(7, 1.0), WORN_TRUTH.without("ripple")
    loaded = WornFriction(smooth, Mismatch(load_friction=0.5), 0.01, -smooth.tau_max)
    growth = slide_worn(loaded, speed) - slide_worn(JointFriction(smooth), speed)
    np.testing.assert_allclose(growth, 0.5 * smooth.coulomb_pos, rtol=1e-3)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_ripple_jumps_at_reversal(sign: float) -> None:
    """Forward it is where it was; backward its phase is later by the knob."""
    speed = np.full(7, sign)
    jumping = slide_worn(WornFriction(WORN_TRUTH, Mismatch(ripple_jump=1.0), 0.01, np.zeros(7)), speed)
    rest = slide_worn(JointFriction(WORN_TRUTH.without("ripple")), speed)
    phase = WORN_TRUTH.ripple_phase + (0.0 if sign > 0 else 1.0)
    np.testing.assert_allclose(jumping - rest, WORN_TRUTH.ripple * np.sin(phase), atol=0.06 * WORN_TRUTH.ripple.max())


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
