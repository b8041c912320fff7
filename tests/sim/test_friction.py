"""Drive friction sticks, breaks away at static friction, follows Stribeck's curve and remembers its direction."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import robots
from armlab.sim.arm.friction import JointFriction
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
    for share in np.linspace(0.0, 1.6, 40000):
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
    for _ in range(20000):
        qd += STEP * (tau - damping * qd - friction.torque(q, qd, np.empty(7))) / inertia
        q += STEP * qd
        friction.advance(STEP * qd, qd)
        track.append(q.copy())
    assert np.abs(qd).max() < 1e-12
    assert (q < 10 * truth.delta).all()
    assert np.abs(track[-1] - track[-5000]).max() < 1e-12


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


def test_the_state_is_kept_at_rest_and_survives_tiny_steps(truth: Truth) -> None:
    friction = JointFriction(truth)
    slide(friction, 0.1, 0.01)
    held = friction.bristle.copy()
    for _ in range(1000):
        friction.advance(np.zeros(7), np.zeros(7))
    np.testing.assert_allclose(friction.bristle, held, rtol=1e-12)


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
