"""Names of joints in sentences to clients."""

from __future__ import annotations

from armlab import robots
from armlab.bridge.command.order import called


def test_a_joint_is_called_as_its_client_knows_it() -> None:
    """ABB calls the third joint of a YuMi the seventh; in ROS they count from the base."""
    yumi = robots.load("yumi_right")
    assert called(yumi, 2, None) == f"joint 3 ({yumi.joint_names[2]})"
    assert called(yumi, 2, 7) == "yumi_robr_joint_3 (number 10 of the message)"
    assert called(yumi, 2, by_axis=True) == "axis_7 (number 7 of the vector)"
    assert called(yumi, 3, by_axis=True) == "axis_3 (number 3 of the vector)"
