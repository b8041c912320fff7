"""Excitation motions stay inside every limit and are what they say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armlab import robots
from armlab.errors import NotConverged, RobotError, ShapeError
from armlab.identify import design_excitation, dither, predicted_uncertainty


@pytest.mark.parametrize("name", ["yumi_left", "yumi_right", "irb2400", "irb7600"])
def test_excitation_stays_inside_the_limits(name: str) -> None:
    robot = robots.load(name)
    motion = design_excitation(robot, seconds=20, seed=3, speed=0.6, acceleration=10.0)
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
    motion = design_excitation(replace(robot, q_min=low, q_max=high, q_home=home), seconds=20)
    q = motion.sample(np.linspace(0, 20, 5001))[0][:, 0]
    assert 0.005 < q.min() < 0.02 < 0.04 < q.max() < 0.055


def test_excitation_is_slow_often_enough_and_reverses() -> None:
    """At least 15 % of samples below 10 % of the speed limit and ten reversals per joint in a minute."""
    robot = robots.load("yumi_left")
    _, qd, _ = design_excitation(robot, seconds=60, seed=0).sample(np.arange(0, 60, 0.004))
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


def test_nonsense_is_refused() -> None:
    robot = robots.load("yumi_left")
    with pytest.raises(ShapeError, match="speed share"):
        design_excitation(robot, speed=1.5)
    with pytest.raises(RobotError, match="Load it first"):
        design_excitation("yumi_left")  # type: ignore[arg-type]
    with pytest.raises(ShapeError, match="at least 10 seconds"):
        design_excitation(robot, seconds=2.0)
    with pytest.raises(ShapeError, match="at least 10 seconds"):
        design_excitation(robot, seconds=float("nan"))
    for wrong in ({"f0": 0.0}, {"harmonics": 0}, {"acceleration": -1.0}, {"rounds": -1}, {"harmonics": 2.5}):
        with pytest.raises(ShapeError, match="at least one harmonic"):
            design_excitation(robot, **wrong)
    for centre in (np.zeros(3), robot.q_max + 1.0, np.full(7, np.nan)):
        with pytest.raises(ShapeError, match="inside the limits"):
            design_excitation(robot, centre=centre)
    for wrong in ({"centre": [np.nan]}, {"centre": 0.0}, {"amplitude": np.inf}, {"frequency": 0.0}):
        with pytest.raises(ShapeError, match="finite pose"):
            dither(**{"centre": [0.0], "seconds": 2.0, **wrong})
    with pytest.raises(ShapeError, match="above 0 s"):
        dither(np.zeros(2), 0.0)


def test_motions_that_collide_are_not_chosen() -> None:
    """The second joint stays above its centre, whatever the candidates; a world without room is refused."""
    robot = robots.load("yumi_left")
    free = design_excitation(robot, seconds=20, speed=0.2)
    bound = np.quantile(free.sample(np.arange(0, 20, 0.1))[0][:, 1], 0.02)
    careful = design_excitation(robot, seconds=20, speed=0.2, collides=lambda q: q[1] < bound)
    assert careful.sample(np.arange(0, 20, 0.1))[0][:, 1].min() >= bound
    with pytest.raises(NotConverged, match="none among 60 candidates"):
        design_excitation(robot, seconds=20, collides=lambda q: True)


def test_motions_beyond_the_torque_limits_are_not_chosen() -> None:
    robot = robots.load("ur5e")
    t = np.arange(0, 20, 0.1)

    def peak(motion) -> np.ndarray:
        return np.abs(robot.chain.rnea(*motion.sample(t), robot.gravity, robot.inertias)).max(axis=0)

    weak = replace(robot, tau_max=0.97 * peak(design_excitation(robot, seconds=20)))
    assert np.all(peak(design_excitation(weak, seconds=20)) <= weak.tau_max)
    with pytest.raises(NotConverged, match=r"torque limits of 'ur5e'.*lower speed and acceleration"):
        design_excitation(replace(robot, tau_max=np.full(6, 0.1)), seconds=20)


def test_noise_weighs_the_joints() -> None:
    """A joint whose torque is noise tells nothing: another motion is the best."""
    robot = robots.load("ur5e")
    t = np.arange(0, 20, 0.5)
    plain = design_excitation(robot, seconds=20).sample(t)[0]
    np.testing.assert_array_equal(design_excitation(robot, seconds=20, sigma=np.full(6, 3.0)).sample(t)[0], plain)
    noisy = design_excitation(robot, seconds=20, sigma=np.array([1e4, 1e4, 1.0, 1e-4, 1e-4, 1e-4])).sample(t)[0]
    assert np.abs(noisy - plain).max() > 0.1
    with pytest.raises(ShapeError, match=r"sigma of shape \(6,\) above 0"):
        design_excitation(robot, sigma=np.zeros(6))


def test_a_search_makes_the_motion_tell_more() -> None:
    """D-optimal: the median of the expected deviations falls by a tenth in 150 rounds, inside all limits."""
    robot = robots.load("yumi_left")
    plain, searched = (design_excitation(robot, seconds=30, rounds=rounds) for rounds in (0, 150))
    assert np.median(predicted_uncertainty(searched, robot).sd) < 0.9 * np.median(
        predicted_uncertainty(plain, robot).sd
    )
    q, qd, qdd = searched.sample(np.linspace(0, 30, 6001))
    assert np.all((q >= robot.q_min + 0.04) & (q <= robot.q_max - 0.04))
    assert np.all(np.abs(qd) <= 0.601 * robot.qd_max)
    assert np.all(np.abs(qdd) <= 15.01)


def test_progress_is_told_and_changes_nothing() -> None:
    robot, heard = robots.load("irb120"), []
    told = design_excitation(robot, seconds=10, rounds=5, progress=lambda *words: heard.append(words))
    quiet = design_excitation(robot, seconds=10, rounds=5)
    assert np.array_equal(told.sample(np.array(3.0))[0], quiet.sample(np.array(3.0))[0])
    assert heard[0] == (0, 65, "choosing among candidates")
    assert heard[-2:] == [(64, 65, "searching around the best"), (65, 65, "done")]
    assert [done for done, *_ in heard] == list(range(66))
