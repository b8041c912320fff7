"""Excitation trajectories, friction runs, and predicted parameter precision."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab import dynamics, identify, log, robots
from armlab.errors import NotConverged, ShapeError
from armlab.identify import Trajectory, design_excitation, dither, friction_run, sequence
from armlab.identify.excite import PredictedUncertainty, predicted_uncertainty
from armlab.state import Command, State


@pytest.mark.parametrize("name", ["yumi_left", "irb2400", "irb7600"])
def test_excitation_stays_inside_the_limits(name: str) -> None:
    robot = robots.load(name)
    motion = design_excitation(robot, seconds=10, seed=3, speed=0.6, acceleration=10.0)
    t = np.linspace(0, 10, 10001)
    q, qd, qdd = motion.sample(t)
    assert np.all(q >= robot.q_min + 0.04)
    assert np.all(q <= robot.q_max - 0.04)
    assert np.all(np.abs(qd) <= 0.601 * robot.qd_max)
    assert np.all(np.abs(qdd) <= 10.01)
    np.testing.assert_allclose(np.gradient(q, t, axis=0)[1:-1], qd[1:-1], atol=1e-3)
    np.testing.assert_allclose(np.gradient(qd, t, axis=0)[1:-1], qdd[1:-1], atol=2e-2)
    np.testing.assert_array_equal(qd[[0, -1]], 0.0)
    axes = q @ np.linalg.inv(robot.coupling / np.diag(robot.coupling)).T  # a rod's axis 3: q_2 + q_3
    assert np.all((axes >= robot.q_min + 0.04) & (axes <= robot.q_max - 0.04))


def test_a_joint_with_a_short_stroke_moves_inside_it() -> None:
    robot = robots.load("yumi_left")
    low, high, home = robot.q_min.copy(), robot.q_max.copy(), robot.q_home.copy()
    low[0], high[0], home[0] = 0.0, 0.06, 0.03
    motion = design_excitation(replace(robot, q_min=low, q_max=high, q_home=home), seconds=10)
    q = motion.sample(np.linspace(0, 10, 2501))[0][:, 0]
    assert 0.005 < q.min() < 0.02 < 0.04 < q.max() < 0.055


def test_excitation_is_slow_often_enough_and_reverses() -> None:
    """At least 15 % of samples below 10 % of the speed limit and ten reversals per joint in a minute."""
    robot = robots.load("yumi_left")
    _, qd, _ = design_excitation(robot, seconds=30, seed=0).sample(np.arange(0, 30, 0.01))
    assert np.all(np.mean(np.abs(qd) < 0.1 * robot.qd_max, axis=0) > 0.15)
    assert np.all(np.sum(np.diff(np.sign(qd), axis=0) != 0, axis=0) >= 5)


@pytest.mark.parametrize("seconds", [0.7, 3.3])
def test_a_short_sway_has_no_jump_either(seconds: float) -> None:
    t = np.linspace(0, seconds, 20001)
    q, qd, qdd = dither(np.zeros(3), seconds, amplitude=1.0).sample(t)
    np.testing.assert_allclose(np.gradient(q, t, axis=0)[1:-1], qd[1:-1], atol=1e-4)
    assert np.abs(np.diff(qd, axis=0)).max() < 1.5 * np.abs(qdd).max() * t[1]


def test_motions_that_collide_are_not_chosen() -> None:
    """The second joint stays above its centre, for any candidates; a workspace without room is refused."""
    robot = robots.load("yumi_left")
    free = design_excitation(robot, seconds=10, speed=0.2)
    bound = np.quantile(free.sample(np.arange(0, 10, 0.1))[0][:, 1], 0.02)
    careful = design_excitation(robot, seconds=10, speed=0.2, collides=lambda q: q[1] < bound)
    assert careful.sample(np.arange(0, 10, 0.1))[0][:, 1].min() >= bound
    with pytest.raises(NotConverged, match="none among 60 candidates"):
        design_excitation(robot, seconds=10, collides=lambda q: True)


def test_motions_beyond_the_torque_limits_are_not_chosen() -> None:
    robot = robots.load("ur5e")
    t = np.arange(0, 10, 0.1)

    def peak(motion) -> np.ndarray:
        return np.abs(robot.chain.rnea(*motion.sample(t), robot.gravity, robot.inertias)).max(axis=0)

    weak = replace(robot, tau_max=0.97 * peak(design_excitation(robot, seconds=10)))
    assert np.all(peak(design_excitation(weak, seconds=10)) <= weak.tau_max)
    with pytest.raises(NotConverged, match=r"torque limits of 'ur5e'.*lower speed and acceleration"):
        design_excitation(replace(robot, tau_max=np.full(6, 0.1)), seconds=10)


def test_noise_weighs_the_joints() -> None:
    """A joint whose torque is pure noise gives no information, so another motion is best."""
    robot = robots.load("ur5e")
    t = np.arange(0, 10, 0.5)
    plain = design_excitation(robot, seconds=10).sample(t)[0]
    np.testing.assert_array_equal(design_excitation(robot, seconds=10, sigma=np.full(6, 3.0)).sample(t)[0], plain)
    noisy = design_excitation(robot, seconds=10, sigma=np.array([1e4, 1e4, 1.0, 1e-4, 1e-4, 1e-4])).sample(t)[0]
    assert np.abs(noisy - plain).max() > 0.1
    with pytest.raises(ShapeError, match=r"sigma of shape \(6,\) above 0"):
        design_excitation(robot, sigma=np.zeros(6))


@pytest.mark.slow
def test_a_search_makes_the_motion_tell_more() -> None:
    """D-optimal: the median expected standard deviation falls by a tenth in 100 rounds, within all limits."""
    robot = robots.load("yumi_left")
    plain, searched = (design_excitation(robot, seconds=20, rounds=rounds) for rounds in (0, 100))
    assert np.median(predicted_uncertainty(searched, robot).sd) < 0.9 * np.median(
        predicted_uncertainty(plain, robot).sd
    )
    q, qd, qdd = searched.sample(np.linspace(0, 20, 2001))
    assert np.all((q >= robot.q_min + 0.04) & (q <= robot.q_max - 0.04))
    assert np.all(np.abs(qd) <= 0.601 * robot.qd_max)
    assert np.all(np.abs(qdd) <= 15.01)


def test_progress_is_told_and_changes_nothing() -> None:
    robot, heard = robots.load("irb120"), []
    told = design_excitation(robot, seconds=10, rounds=5, progress=lambda *words: heard.append(words))
    quiet = design_excitation(robot, seconds=10, rounds=5)
    assert np.array_equal(told.sample(np.array(3.0))[0], quiet.sample(np.array(3.0))[0])
    assert heard[0] == (0, 65, "evaluating candidates")
    assert heard[-2:] == [(64, 65, "refining the best candidate"), (65, 65, "done")]
    assert [done for done, *_ in heard] == list(range(66))


def test_sequence_walks_between_its_parts_without_a_jump() -> None:
    a, b = dither(np.zeros(2), 5.0), dither(np.array([0.5, -0.5]), 5.0)
    motion = sequence([a, b], walk=2.0)
    assert isinstance(motion, Trajectory)
    assert motion.seconds == pytest.approx(12.0)
    t = np.linspace(0, 12, 4801)
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


def test_a_motion_is_saved_and_run_again(tmp_path) -> None:
    """A CSV file at 250 Hz restores the same motion, so that a saved design can be run later."""
    robot = robots.load("yumi_left")
    motion = design_excitation(robot, seconds=10.3, seed=2)
    path = log.write(motion.table(), tmp_path / "excite.csv")
    again = Trajectory.from_table(log.read(path))
    assert again.seconds == pytest.approx(motion.seconds)
    t = np.linspace(-1, 12, 1000)
    for x, y, tolerance in zip(again.sample(t), motion.sample(t), (1e-7, 1e-5, 1e-2)):
        np.testing.assert_allclose(x, y, atol=tolerance)
    np.testing.assert_allclose(again.q_first, motion.q_first, atol=1e-12)


# Friction runs.


@pytest.mark.parametrize(("name", "joint"), [("yumi_left", 0), ("yumi_right", 5), ("irb2400", 2), ("ur5e", 1)])
def test_constant_speeds_both_ways_with_holds(name: str, joint: int) -> None:
    robot = robots.load(name)
    run = friction_run(robot, robot.joint_names[joint] if joint else joint)
    t = np.arange(0, run.seconds, 0.004)
    q, qd, qdd = run.sample(t)
    assert np.all(q >= robot.q_min)
    assert np.all(q <= robot.q_max)
    assert np.all(np.abs(qdd) <= 1.001 * robot.qdd_max)
    others = np.arange(robot.n) != joint
    assert not qd[:, others].any()
    steady = np.abs(qdd[:, joint]) == 0
    speeds, ways = steady_runs(t, q[:, joint], qd[:, joint], steady)
    top = 0.8 * robot.qd_max[joint]
    expected = np.geomspace(0.005, top, 10)
    np.testing.assert_allclose(np.abs(speeds[::2]), [*expected, expected[4]], rtol=1e-9)
    np.testing.assert_allclose(speeds[::2], -speeds[1::2], rtol=1e-9)
    gear = abs(1 / robot.coupling[joint, joint])
    period = np.pi / gear if gear > 1 else 0.03
    assert np.all(np.abs(ways) >= 10 * period - 2 * 0.004 * np.abs(speeds))
    np.testing.assert_allclose(q[-1], q[0], atol=1e-9)
    assert not qd[[0, -1]].any()


def steady_runs(t: np.ndarray, q: np.ndarray, qd: np.ndarray, steady: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the speed and travel of each constant-speed segment that is not a hold; check that holds last 2 s."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], steady.astype(int), [0]]))).reshape(-1, 2)
    edges = edges[edges[:, 1] - edges[:, 0] > 3]
    speeds = np.array([np.median(qd[a:b]) for a, b in edges])
    ways = np.array([q[b - 1] - q[a] for a, b in edges])
    holds = np.array([t[b - 1] - t[a] for a, b in edges])[speeds == 0]
    assert np.all(holds > 1.98)
    return speeds[speeds != 0], ways[speeds != 0]


def test_a_short_joint_runs_less_fast_or_not_at_all() -> None:
    robot = robots.load("irb2400")
    low, high, home = robot.q_min.copy(), robot.q_max.copy(), robot.q_home.copy()
    low[0], high[0], home[0] = -0.3, 0.3, 0.0
    short = replace(robot, q_min=low, q_max=high, q_home=home)
    q, qd, _ = friction_run(short, 0).sample(np.arange(0, 400, 0.01))
    assert 0.05 < np.abs(qd[:, 0]).max() < 0.79 * robot.qd_max[0]
    assert np.abs(q[:, 0]).max() < 0.3
    low[0], high[0] = -0.1, 0.1
    with pytest.raises(ShapeError, match=r"room for a run of 0.3 rad .*Use identify\.design_excitation"):
        friction_run(replace(robot, q_min=low, q_max=high, q_home=home), 0)


# Predicted parameter uncertainty.


@pytest.fixture(scope="module")
def motion() -> identify.Trajectory:
    return identify.design_excitation(robots.load("yumi_left"), seconds=15.0, seed=1)


@pytest.fixture(scope="module")
def expected(motion: identify.Trajectory) -> PredictedUncertainty:
    return predicted_uncertainty(motion, robots.load("yumi_left"), noise=0.1)


def test_every_parameter_has_a_group_and_a_deviation(expected: PredictedUncertainty) -> None:
    assert len(expected.names) == len(expected.units) == len(expected.groups) == len(expected.sd)
    assert np.all(expected.sd > 0)
    assert set(expected.groups) == {"first moments", "inertias", "viscous", "Coulomb", "offset"}
    assert all(unit == "kg m" for unit, group in zip(expected.units, expected.groups) if group == "first moments")
    head, *rows = expected.rows()
    assert head[0] == "group"
    assert sum(int(row[2]) for row in rows) == len(expected.names)


def test_deviations_follow_the_noise_and_the_length(
    expected: PredictedUncertainty, motion: identify.Trajectory
) -> None:
    robot = robots.load("yumi_left")
    assert predicted_uncertainty(motion, robot, noise=0.2).sd == pytest.approx(2 * expected.sd)
    twice = predicted_uncertainty(identify.sequence([motion, motion], walk=0.1), robot)
    assert np.median(twice.sd / expected.sd) == pytest.approx(np.sqrt(0.5), rel=0.05)


def test_the_spread_of_fits_is_what_was_expected(expected: PredictedUncertainty, motion: identify.Trajectory) -> None:
    """Least squares on the expected regressor with white noise: the standard deviations match those of 200 fits."""
    robot = robots.load("yumi_left")
    q, qd, qdd = motion.sample(np.arange(0.0, 15.0, 0.02))
    base = dynamics.base_parameters(robot)
    rotor = np.zeros((len(q), 7, 7))
    rotor[:, range(7), range(7)] = qdd
    A = np.zeros((len(q), 7, len(expected.names)))
    rigid = np.concatenate([robot.chain.rigid_regressor(q, qd, qdd, robot.gravity), rotor], axis=2)
    A[:, :, : len(base.names)] = rigid[:, :, base.kept]
    for i in range(7):
        columns = (qd[:, i], qd[:, i] > 0, -1.0 * (qd[:, i] < 0), np.ones(len(q)))
        A[:, i, len(base.names) + 4 * i : len(base.names) + 4 * i + 4] = np.stack(columns, axis=1)
    A = A.reshape(-1, len(expected.names))
    noise = np.random.default_rng(1).normal(0.0, 0.1 / np.sqrt(5.0), (len(A), 200))  # 5 logged samples per sample here
    spread = np.linalg.lstsq(A, noise, rcond=None)[0].std(axis=1)
    assert np.median(spread / expected.sd) == pytest.approx(1.0, abs=0.03)
    assert np.all(np.abs(spread / expected.sd - 1) < 0.25)
