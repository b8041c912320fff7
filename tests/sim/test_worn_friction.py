"""Friction that warms, that grows with load, whose ripple knows the direction."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import robots
from armlab.sim.arm.friction import WARM_TIME, JointFriction, WornFriction
from armlab.sim.arm.mismatch import Mismatch
from armlab.sim.arm.truth import synthetic_truth

ROBOT = robots.load("yumi_left")
TRUTH = synthetic_truth(ROBOT).without("offset")


def slide(friction: JointFriction, speed: np.ndarray, step: float = 0.01, count: int = 50) -> np.ndarray:
    """Torque after sliding `count` steps."""
    for _ in range(count):
        friction.advance(speed * step, speed)
    return friction.torque(np.zeros(7), speed, np.empty(7))


def test_nothing_turned_is_plain_friction_to_the_last_bit() -> None:
    speed = 0.3 * np.array([1, -1, 1, -1, 1, -1, 1.0])
    worn = WornFriction(TRUTH, Mismatch(), 0.01, np.full(7, 3.0))
    np.testing.assert_array_equal(slide(worn, speed), slide(JointFriction(TRUTH), speed))


def test_a_warm_drive_has_lost_its_share_of_viscous_friction() -> None:
    """At a quarter of full speed the warmth settles at 1, with the time constant of 12 minutes."""
    smooth = TRUTH.without("ripple")
    speed = 0.25 * ROBOT.qd_max
    friction = WornFriction(smooth, Mismatch(warm_up=0.4), 1.0, np.zeros(7))
    cold = slide(JointFriction(smooth), speed, 1.0)
    slide(friction, speed, 1.0, round(WARM_TIME))
    assert np.all(friction.warmth > 0.5)
    assert np.all(friction.warmth < 1 - np.exp(-1.0) + 0.01)
    warm = slide(friction, speed, 1.0, 7 * round(WARM_TIME))
    assert np.all(friction.warmth > 0.9)
    lost = 0.4 * np.minimum(friction.warmth, 1.0) * smooth.viscous * speed
    np.testing.assert_allclose(cold - warm, lost, rtol=1e-3)


def test_load_presses_on_the_bearings() -> None:
    speed, smooth = np.full(7, 1.0), TRUTH.without("ripple")
    loaded = WornFriction(smooth, Mismatch(load_friction=0.5), 0.01, -smooth.tau_max)
    growth = slide(loaded, speed) - slide(JointFriction(smooth), speed)
    np.testing.assert_allclose(growth, 0.5 * smooth.coulomb_pos, rtol=1e-3)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_ripple_jumps_at_reversal(sign: float) -> None:
    """Forward it is where it was; backward its phase is later by the knob."""
    speed = np.full(7, sign)
    jumping = slide(WornFriction(TRUTH, Mismatch(ripple_jump=1.0), 0.01, np.zeros(7)), speed)
    rest = slide(JointFriction(TRUTH.without("ripple")), speed)
    phase = TRUTH.ripple_phase + (0.0 if sign > 0 else 1.0)
    np.testing.assert_allclose(jumping - rest, TRUTH.ripple * np.sin(phase), atol=0.06 * TRUTH.ripple.max())
