"""`called`: the name of a joint in sentences to the client that commands it."""

from __future__ import annotations

from armlab.robots import Robot

__all__ = ["called"]


def called(robot: Robot, i: int, first: int | None = None, by_axis: bool = False) -> str:
    """Return what a joint is called by the client that commands it, with its place in what was sent.

    Parameters
    ----------
    robot : the arm. i : index of the joint, from 0.
    first : place of the arm's first number in a ROS message, from 0; None for a command that was none.
    by_axis : the numbers of a command that was none stood in ABB's order, axes 1 to n.
    """
    if first is not None:
        return f"{robot.ros_joint_names[i]} (number {first + i + 1} of the message)"
    if by_axis:
        return f"{robot.joint_names[i]} (number {robot.abb_axes[i]} of the vector)"
    return f"joint {i + 1} ({robot.joint_names[i]})"
