"""`joint_names`: what the joints of an arm are called in ROS, and `called`, for sentences to a client."""

from __future__ import annotations

from armlab.robots import Robot

__all__ = ["called", "joint_names"]

_YUMI = (1, 2, 7, 3, 4, 5, 6)


def joint_names(robot: Robot) -> list[str]:
    """Return the names of the joints in ROS: the description's, but of a YuMi those of abb_robot_driver.

    Those count from base to tool; ABB, and so the description, calls the third of a YuMi's joints the seventh.

    Parameters
    ----------
    robot : the arm.
    """
    if robot.abb_axes == _YUMI and robot.side:
        return [f"yumi_rob{robot.side[0]}_joint_{k}" for k in range(1, robot.n + 1)]
    return list(robot.joint_names)


def called(robot: Robot, i: int, first: int | None = None, by_axis: bool = False) -> str:
    """Return what a joint is called by the client that commands it, with its place in what was sent.

    Parameters
    ----------
    robot : the arm. i : index of the joint, from 0.
    first : place of the arm's first number in a ROS message, from 0; None for a command that was none.
    by_axis : the numbers of a command that was none stood in ABB's order, axes 1 to n.
    """
    if first is not None:
        return f"{joint_names(robot)[i]} (number {first + i + 1} of the message)"
    if by_axis:
        return f"{robot.joint_names[i]} (number {robot.abb_axes[i]} of the vector)"
    return f"joint {i + 1} ({robot.joint_names[i]})"
