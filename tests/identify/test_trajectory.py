"""Motions are joined, saved, read back and run without a jump."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import log, robots
from armlab.errors import ShapeError
from armlab.identify import Trajectory, design_excitation, dither, sequence
from armlab.identify.excite import quintic_step
from armlab.state import Command, State


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


def test_nothing_to_join_is_refused() -> None:
    with pytest.raises(ShapeError, match="at least one motion"):
        sequence([])
    with pytest.raises(ShapeError, match="walk above 0"):
        sequence([dither(np.zeros(2), 5.0)], walk=0.0)


def test_the_smooth_step_and_its_derivatives() -> None:
    x = np.linspace(0, 1, 1001)
    s, ds, dds = np.array([quintic_step(value) for value in x]).T
    np.testing.assert_allclose(s[[0, 500, -1]], [0, 0.5, 1], atol=1e-12)
    np.testing.assert_allclose(np.gradient(s, x)[1:-1], ds[1:-1], atol=1e-4)
    np.testing.assert_allclose(np.gradient(ds, x)[1:-1], dds[1:-1], atol=1e-3)
    assert quintic_step(-1.0)[0] == 0.0
    assert quintic_step(2.0)[0] == 1.0


def test_a_motion_is_saved_and_run_again(tmp_path) -> None:
    """Through a CSV file at 250 Hz the same motion comes back: what is designed today runs tomorrow."""
    robot = robots.load("yumi_left")
    motion = design_excitation(robot, seconds=12.3, seed=2)
    path = log.write(motion.table(), tmp_path / "excite.csv")
    again = Trajectory.from_table(log.read(path))
    assert again.seconds == pytest.approx(motion.seconds)
    t = np.linspace(-1, 14, 2000)
    for x, y, tolerance in zip(again.sample(t), motion.sample(t), (1e-7, 1e-5, 1e-2)):
        np.testing.assert_allclose(x, y, atol=tolerance)
    np.testing.assert_allclose(again.q_first, motion.q_first, atol=1e-12)


def test_tables_that_are_no_motion_are_refused() -> None:
    motion = dither(np.zeros(2), 5.0)
    with pytest.raises(ShapeError, match=r"rest at both ends, got 0\.\d+ rad/s"):
        Trajectory.from_table(motion.table().between(0.0, 3.3))
    holed = motion.table().with_column("q", np.full((1251, 2), np.nan))
    with pytest.raises(ShapeError, match="without missing values"):
        Trajectory.from_table(holed)
    with pytest.raises(ShapeError, match="rate above 0 Hz"):
        motion.table(rate=0.0)
