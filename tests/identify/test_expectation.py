"""What a motion will tell, before the robot has moved."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import identify, robots
from armlab.errors import ShapeError
from armlab.identify.excite import PredictedUncertainty, predicted_uncertainty


@pytest.fixture(scope="module")
def motion() -> identify.Trajectory:
    return identify.design_excitation(robots.load("yumi_left"), seconds=30.0, seed=1)


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
    """Least squares on the expected regressor itself, with white noise: the deviations are those of 200 fits."""
    from armlab.identify.base_parameters import base_parameters

    robot = robots.load("yumi_left")
    q, qd, qdd = motion.sample(np.arange(0.0, 30.0, 0.02))
    base = base_parameters(robot)
    rotor = np.zeros((len(q), 7, 7))
    rotor[:, range(7), range(7)] = qdd
    A = np.zeros((len(q), 7, len(expected.names)))
    rigid = np.concatenate([robot.chain.rigid_regressor(q, qd, qdd, robot.gravity), rotor], axis=2)
    A[:, :, : len(base.names)] = rigid[:, :, base.kept]
    for i in range(7):
        columns = (qd[:, i], qd[:, i] > 0, -1.0 * (qd[:, i] < 0), np.ones(len(q)))
        A[:, i, len(base.names) + 4 * i : len(base.names) + 4 * i + 4] = np.stack(columns, axis=1)
    A = A.reshape(-1, len(expected.names))
    noise = np.random.default_rng(1).normal(0.0, 0.1 / np.sqrt(5.0), (len(A), 200))  # 5 logged samples for one here
    spread = np.linalg.lstsq(A, noise, rcond=None)[0].std(axis=1)
    assert np.median(spread / expected.sd) == pytest.approx(1.0, abs=0.03)
    assert np.all(np.abs(spread / expected.sd - 1) < 0.25)


@pytest.mark.parametrize("noise", [0.0, -1.0, np.nan, np.inf])
def test_noise_must_be_above_zero(noise: float) -> None:
    robot = robots.load("yumi_left")
    with pytest.raises(ShapeError, match="noise above 0"):
        predicted_uncertainty(identify.dither(robot.q_home, 5.0), robot, noise)


def test_a_motion_of_another_arm_is_refused() -> None:
    with pytest.raises(ShapeError, match="6 joints"):
        predicted_uncertainty(identify.dither(robots.load("yumi_left").q_home, 5.0), robots.load("irb2400"))
