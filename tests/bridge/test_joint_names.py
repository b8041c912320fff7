"""Names of joints in ROS, and in sentences to clients."""

from __future__ import annotations

from armlab import robots
from armlab.bridge.joint_names import called, joint_names

ROBOT = robots.load("irb120")


def test_joints_of_a_yumi_have_the_names_of_abb_robot_driver() -> None:
    left, right = joint_names(robots.load("yumi_left")), joint_names(robots.load("yumi_right_urdf"))
    assert left == [f"yumi_robl_joint_{k}" for k in range(1, 8)]
    assert right == [f"yumi_robr_joint_{k}" for k in range(1, 8)]
    assert joint_names(ROBOT) == list(ROBOT.joint_names)


def test_a_joint_is_called_as_its_client_knows_it() -> None:
    """ABB calls the third joint of a YuMi the seventh; in ROS they count from the base."""
    yumi = robots.load("yumi_right")
    assert called(yumi, 2, None) == f"joint 3 ({yumi.joint_names[2]})"
    assert called(yumi, 2, 7) == "yumi_robr_joint_3 (number 10 of the message)"
    assert called(yumi, 2, by_axis=True) == "axis_7 (number 7 of the vector)"
    assert called(yumi, 3, by_axis=True) == "axis_3 (number 3 of the vector)"
