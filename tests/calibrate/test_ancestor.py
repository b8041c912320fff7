"""Defects of the ancestor's calibrations that must not return and that no other test shows (see docs/decisions)."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.calibrate import fit_force_sensor, fit_laser_plane
from armlab.lie import se3, so3

G = np.array([0.0, 0.0, -9.82])


def test_small_tilts_cost_degrees_not_half_turns(weights) -> None:
    """calib_force: 58 to 178 degrees off at tilts below 30 degrees; the bound is 0.544."""
    squares = []
    for run in range(40):
        data = weights.draw([3000, run], tilt=np.radians(30.0))
        fit = fit_force_sensor(**data.given, noise=0.1)
        squares.append(so3.angle(fit.value.R_tool_sensor, data.R) ** 2)
    assert np.degrees(np.sqrt(np.max(squares))) < 3.0
    assert np.degrees(np.sqrt(np.mean(squares))) < 0.544 * 1.3


@pytest.mark.parametrize("half", [np.diag([1.0, -1, -1]), np.diag([-1.0, 1, -1]), np.diag([-1.0, -1, 1])])
def test_sensors_turned_by_half_a_turn_are_like_others(weights, half) -> None:
    """calib_force2 was singular there."""
    data = weights.draw(1, 20, 0.0)
    fit = fit_force_sensor(data.RA, 0.7 * G @ data.RA @ half + [1.0, 2.0, 3.0], gravity=G)
    np.testing.assert_allclose(fit.value.R_tool_sensor, half, atol=1e-12)
    np.testing.assert_allclose(fit.value.bias[:3], [1.0, 2.0, 3.0], atol=1e-11)


def test_poses_are_taken_as_well_as_orientations(weights) -> None:
    """calib_force_iterative failed on 4x4 poses."""
    data = weights.draw(2)
    one = fit_force_sensor(data.RA, data.y, gravity=G)
    other = fit_force_sensor(se3.from_rp(data.RA, np.ones((len(data.RA), 3))), data.y, gravity=G)
    np.testing.assert_array_equal(one.value.R_tool_sensor, other.value.R_tool_sensor)
    np.testing.assert_array_equal(one.cov, other.cov)


def test_torques_tell_the_rotation_too(weights) -> None:
    """They were never used: with them the rotation is known about twice as well."""
    data = weights.draw(3, torque=0.005)
    alone = fit_force_sensor(data.RA, data.y[:, :3], gravity=G, noise=0.1)
    both = fit_force_sensor(data.RA, data.y, gravity=G, noise=(0.1, 0.005))
    assert np.trace(both.cov[:3, :3]) < 0.5 * np.trace(alone.cov[:3, :3])


def test_a_line_is_used_where_it_was_measured(laser) -> None:
    """calibNAXP went 1 m along each line for a second point, where the noise of its angle is a hundred times larger."""
    data = laser.draw(4)
    turned = data.exact.copy()  # lines that turned about their points, as by noise of the angle alone
    turn = 8.66e-3 * np.random.default_rng(0).standard_normal(60)
    turned[:, 2] = np.cos(turn) * data.exact[:, 2] - np.sin(turn) * data.exact[:, 3]
    turned[:, 3] = np.sin(turn) * data.exact[:, 2] + np.cos(turn) * data.exact[:, 3]
    fit = fit_laser_plane(data.A, turned, data.plane, noise=(1e-6, 8.66e-3))
    assert np.abs(fit.residuals[:, 0]).max() < 1e-5  # the points stay where they are
    np.testing.assert_allclose(fit.value.T_tool_sensor, data.X, atol=0.01)
