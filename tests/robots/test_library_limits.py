"""Limits, speeds, reach and torques of the library against those that the vendors publish."""

from __future__ import annotations

import numpy as np
import pytest

from armlab import kinematics, robots

LIMITS = {  # degrees; rounded as a URDF in rad prints them
    "irb120": ((-165, -110, -110, -160, -120, -400), (165, 110, 70, 160, 120, 400), (250, 250, 250, 320, 320, 420)),
    "irb1200": ((-170, -100, -200, -270, -130, -360), (170, 130, 70, 270, 130, 360), (288, 240, 300, 400, 405, 600)),
    "irb1200_7_70": (
        (-170, -100, -200, -270, -130, -360),
        (170, 135, 70, 270, 130, 360),
        (288, 240, 300, 400, 405, 600),
    ),
    "irb7600_150_350": (
        (-180, -60, -180, -300, -100, -360),
        (180, 85, 60, 300, 100, 360),
        (100, 60, 60, 100, 100, 190),
    ),
    "ur5e": ((-360,) * 6, (360,) * 6, (180,) * 6),
    "panda": (
        (-166.0, -101.0, -166.0, -176.0, -166.0, -1.0, -166.0),
        (166.0, 101.0, 166.0, -4.0, 166.0, 215.0, 166.0),
        (124.6, 124.6, 124.6, 124.6, 149.5, 149.5, 149.5),
    ),
    "fr3": (
        (-157.2, -102.2, -166.2, -174.3, -160.8, 31.2, -172.8),
        (157.2, 102.2, 166.2, -8.7, 160.8, 258.8, 172.8),
        (150.1, 150.1, 150.1, 150.1, 301.4, 239.5, 301.4),
    ),
    "iiwa14": (
        (-170, -120, -170, -120, -170, -120, -175),
        (170, 120, 170, 120, 170, 120, 175),
        (85, 85, 100, 75, 130, 135, 135),
    ),
}


@pytest.mark.parametrize("name", LIMITS)
def test_limits_and_speeds(name: str) -> None:
    robot = robots.load(name)
    for field, degrees in zip((robot.q_min, robot.q_max, robot.qd_max), LIMITS[name], strict=True):
        np.testing.assert_allclose(np.rad2deg(field), degrees, rtol=0, atol=0.06)


REACH = {"irb120": 0.58, "irb1200": 0.90, "irb1200_7_70": 0.70, "irb7600": 2.55, "irb7600_150_350": 3.50}


@pytest.mark.parametrize("name", REACH)
def test_reach_is_that_of_the_type_name(name: str) -> None:
    """ABB names an arm after the largest distance of its wrist from axis 1."""
    robot = robots.load(name)
    q = np.zeros((200, 200, 6))
    q[..., 1], q[..., 2] = np.meshgrid(*np.linspace(robot.q_min[1:3], robot.q_max[1:3], 200).T, indexing="ij")
    wrist = kinematics.link_transforms(robot, q)[..., 4, :3, 3]
    assert np.hypot(wrist[..., 0], wrist[..., 1]).max() == pytest.approx(REACH[name], abs=0.005)


@pytest.mark.parametrize("name", ["iiwa14", "ur5e"])
def test_home_points_the_tool_down(name: str) -> None:
    robot = robots.load(name)
    np.testing.assert_allclose(kinematics.forward(robot, robot.q_home)[:3, 2], [0, 0, -1], rtol=0, atol=1e-15)


EFFORTS = {"ur5e": [150] * 3 + [28] * 3, "panda": [87] * 4 + [12] * 3, "fr3": [87] * 4 + [12] * 3}
EFFORTS["iiwa14"] = [320, 320, 176, 176, 110, 40, 40]


@pytest.mark.parametrize("name", robots.names())
def test_torque_limits_are_those_of_the_vendor_or_none(name: str) -> None:
    np.testing.assert_array_equal(robots.load(name).tau_max, EFFORTS.get(name, np.inf))
