"""Excitation motions stay inside every limit and are what they say."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import robots
from armlab.errors import ShapeError
from armlab.identify import Trajectory, dither, excitation, sequence
from armlab.state import Command, State


@pytest.mark.parametrize("name", ["yumi_left", "yumi_right", "irb2400"])
def test_excitation_stays_inside_the_limits(name: str) -> None:
    robot = robots.load(name)
    motion = excitation(robot, seconds=20, seed=3, speed=0.6, acceleration=10.0)
    t = np.linspace(0, 20, 20001)
    q, qd, qdd = motion.sample(t)
    assert np.all(q >= robot.q_min + 0.04)
    assert np.all(q <= robot.q_max - 0.04)
    assert np.all(np.abs(qd) <= 0.605 * robot.qd_max)
    assert np.all(np.abs(qdd) <= 10.2)
    np.testing.assert_allclose(np.gradient(q, t, axis=0)[1:-1], qd[1:-1], atol=1e-3)
    np.testing.assert_allclose(np.gradient(qd, t, axis=0)[1:-1], qdd[1:-1], atol=2e-2)
    np.testing.assert_array_equal(qd[[0, -1]], 0.0)


def test_excitation_is_slow_often_enough_and_reverses() -> None:
    """At least 15 % of samples below 10 % of the speed limit and ten reversals per joint in a minute."""
    robot = robots.load("yumi_left")
    _, qd, _ = excitation(robot, seconds=60, seed=0).sample(np.arange(0, 60, 0.004))
    assert np.all(np.mean(np.abs(qd) < 0.1 * robot.qd_max, axis=0) > 0.15)
    assert np.all(np.sum(np.diff(np.sign(qd), axis=0) != 0, axis=0) >= 10)


def test_dither_sways_every_joint_about_its_centre() -> None:
    centre = np.array([0.1, -0.2])
    q, qd, _ = dither(centre, seconds=10.0, amplitude=0.03, frequency=0.5).sample(np.linspace(2, 8, 3001))
    np.testing.assert_allclose(q.mean(axis=0), centre, atol=1e-3)
    np.testing.assert_allclose(np.ptp(q, axis=0), 0.06, rtol=1e-3)
    np.testing.assert_allclose(np.abs(qd).max(axis=0), 0.03 * np.pi, rtol=1e-3)


def test_sequence_walks_between_its_parts_without_a_jump() -> None:
    a, b = dither(np.zeros(2), 5.0), dither(np.array([0.5, -0.5]), 5.0)
    motion = sequence([a, b], walk=2.0)
    assert isinstance(motion, Trajectory)
    assert motion.seconds == pytest.approx(12.0)
    t = np.linspace(0, 12, 12001)
    q, qd, qdd = motion.sample(t)
    np.testing.assert_allclose(np.gradient(q, t, axis=0)[1:-1], qd[1:-1], atol=2e-3)
    assert np.abs(qdd).max() < 2.0
    np.testing.assert_allclose(q[-1], [0.5, -0.5], atol=1e-9)


def test_the_controller_walks_to_the_start_and_follows_the_motion() -> None:
    motion = dither(np.array([0.3, 0.3]), 10.0)
    controller = motion.controller(approach=2.0)
    rest = np.zeros(2)

    def at(t: float) -> Command:
        return controller(State(t=t, dt=0.004, q=rest, qd=rest, tau=rest, q_start=rest))

    np.testing.assert_array_equal(at(0.0).q, rest)
    np.testing.assert_allclose(at(2.0 - 1e-9).q, motion.q_first, atol=1e-6)
    expected = motion.sample(np.array(3.0))
    np.testing.assert_allclose(at(5.0).q, expected[0])
    np.testing.assert_allclose(at(5.0).qd, expected[1])


def test_nonsense_is_refused() -> None:
    robot = robots.load("yumi_left")
    with pytest.raises(ShapeError, match="speed share"):
        excitation(robot, speed=1.5)
    with pytest.raises(ShapeError, match="at least 10 seconds"):
        excitation(robot, seconds=2.0)
