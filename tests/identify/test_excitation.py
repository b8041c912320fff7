"""Excitation motions stay inside every limit and are what they say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab import robots
from armlab.errors import ShapeError
from armlab.identify import Trajectory, dither, excitation, sequence
from armlab.state import Command, State


@pytest.mark.parametrize("name", ["yumi_left", "yumi_right", "irb2400", "irb7600"])
def test_excitation_stays_inside_the_limits(name: str) -> None:
    robot = robots.load(name)
    motion = excitation(robot, seconds=20, seed=3, speed=0.6, acceleration=10.0)
    t = np.linspace(0, 20, 20001)
    q, qd, qdd = motion.sample(t)
    assert np.all(q >= robot.q_min + 0.04)
    assert np.all(q <= robot.q_max - 0.04)
    assert np.all(np.abs(qd) <= 0.601 * robot.qd_max)
    assert np.all(np.abs(qdd) <= 10.01)
    np.testing.assert_allclose(np.gradient(q, t, axis=0)[1:-1], qd[1:-1], atol=1e-3)
    np.testing.assert_allclose(np.gradient(qd, t, axis=0)[1:-1], qdd[1:-1], atol=2e-2)
    np.testing.assert_array_equal(qd[[0, -1]], 0.0)


def test_a_joint_with_a_short_stroke_moves_inside_it() -> None:
    robot = robots.load("yumi_left")
    low, high, home = robot.q_min.copy(), robot.q_max.copy(), robot.q_home.copy()
    low[0], high[0], home[0] = 0.0, 0.06, 0.03
    motion = excitation(replace(robot, q_min=low, q_max=high, q_home=home), seconds=20)
    q = motion.sample(np.linspace(0, 20, 5001))[0][:, 0]
    assert 0.005 < q.min() < 0.02 < 0.04 < q.max() < 0.055


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


@pytest.mark.parametrize("seconds", [0.7, 2.0, 3.3])
def test_a_short_sway_has_no_jump_either(seconds: float) -> None:
    t = np.linspace(0, seconds, 20001)
    q, qd, qdd = dither(np.zeros(3), seconds, amplitude=1.0).sample(t)
    np.testing.assert_allclose(np.gradient(q, t, axis=0)[1:-1], qd[1:-1], atol=1e-4)
    assert np.abs(np.diff(qd, axis=0)).max() < 1.5 * np.abs(qdd).max() * t[1]


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


def states(times: np.ndarray, session: int = 1) -> list[State]:
    rest = np.zeros(2)
    steps = np.diff(times, prepend=times[0] - 0.004)
    return [State(t=t, dt=dt, q=rest, qd=rest, tau=rest, q_start=rest, session=session) for t, dt in zip(times, steps)]


def test_the_controller_walks_to_the_start_and_follows_the_motion() -> None:
    motion = dither(np.array([0.3, 0.3]), 10.0)
    controller = motion.controller(approach=2.0)
    times = np.arange(0, 8, 0.004)
    commands = [controller(state) for state in states(times)]
    assert isinstance(commands[0], Command)
    np.testing.assert_array_equal(commands[0].q, 0.0)
    np.testing.assert_allclose(commands[500].q, motion.q_first, atol=1e-6)
    expected = motion.sample(times[500:] - 2.0)
    np.testing.assert_allclose([c.q for c in commands[500:]], expected[0], atol=1e-9)
    np.testing.assert_allclose([c.qd for c in commands[500:]], expected[1], atol=1e-9)


def test_after_lost_packets_the_motion_goes_on_without_a_jump_and_a_new_session_starts_over() -> None:
    motion = dither(np.zeros(2), 20.0, amplitude=0.5, frequency=1.0)
    controller = motion.controller(approach=1.0)
    times = np.concatenate([np.arange(0, 5, 0.004), np.arange(5.5, 8, 0.004)])
    commands = np.array([controller(state).q for state in states(times)])
    assert np.abs(np.diff(commands, axis=0)).max() < 0.5 * 2 * np.pi * 0.0061
    (first,) = [controller(state).q for state in states(np.array([0.0]), session=2)]
    np.testing.assert_array_equal(first, 0.0)


def test_nonsense_is_refused() -> None:
    robot = robots.load("yumi_left")
    with pytest.raises(ShapeError, match="speed share"):
        excitation(robot, speed=1.5)
    with pytest.raises(ShapeError, match="at least 10 seconds"):
        excitation(robot, seconds=2.0)
    with pytest.raises(ShapeError, match="at least 10 seconds"):
        excitation(robot, seconds=float("nan"))
    for wrong in ({"f0": 0.0}, {"harmonics": 0}, {"acceleration": -1.0}):
        with pytest.raises(ShapeError, match="at least one harmonic"):
            excitation(robot, **wrong)
    for centre in (np.zeros(3), robot.q_max + 1.0, np.full(7, np.nan)):
        with pytest.raises(ShapeError, match="inside the limits"):
            excitation(robot, centre=centre)
    with pytest.raises(ShapeError, match="above 0 s"):
        dither(np.zeros(2), 0.0)
    with pytest.raises(ShapeError, match="at least one motion"):
        sequence([])
    with pytest.raises(ShapeError, match="walk above 0"):
        sequence([dither(np.zeros(2), 5.0)], walk=0.0)
