"""`Arm`: one arm in one row, with what several of its messages need worked out once."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any

import numpy as np

from armlab import kinematics
from armlab.bridge.ros.types import store
from armlab.bridge.row import Row
from armlab.lie import quaternion
from armlab.robots import Robot

__all__ = ["Arm", "header", "joint_names"]

_YUMI = (1, 2, 7, 3, 4, 5, 6)


class Arm:
    """One arm in one row.

    Parameters
    ----------
    robot : the arm. row : in which it is fresh.
    """

    def __init__(self, robot: Robot, row: Row) -> None:
        self.robot, self._values = robot, row.values
        self.wall_ns = row.wall_ns

    def __getitem__(self, name: str) -> Any:
        """Return a value of the row, named without the robot."""
        return self._values[f"{self.robot.name}.{name}"]

    def numbers(self, name: str) -> np.ndarray:
        """Return an array of the row, or an empty one when it is not there (a number is NaN)."""
        values = self[name]
        return _NONE if np.isnan(values).any() else values

    @property
    def joint_names(self) -> list[str]:
        """Names that ROS programs know, base to tool."""
        return joint_names(self.robot)

    @cached_property
    def T_base_tool(self) -> np.ndarray:
        """(4, 4) by the measured joints."""
        return kinematics.forward(self.robot, self["q"])

    @property
    def tool_quaternion(self) -> np.ndarray:
        """Orientation of the tool in base axes, w x y z."""
        return quaternion.from_matrix(self.T_base_tool[:3, :3])

    def in_tool_axes(self, wrench: np.ndarray) -> np.ndarray:
        """Return a wrench (6,) of base axes at the tool point in the axes of the tool."""
        return (wrench.reshape(2, 3) @ self.T_base_tool[:3, :3]).reshape(6)

    def covariance_in_tool_axes(self, cov: np.ndarray) -> np.ndarray:
        """Return the covariance (6, 6) of a wrench in the axes of the tool."""
        both = np.kron(np.eye(2), self.T_base_tool[:3, :3])
        return both.T @ cov @ both


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


def header(stamp_ns: int, frame_id: str = "") -> Any:
    """Return a std_msgs/msg/Header.

    Parameters
    ----------
    stamp_ns : wall clock. frame_id : name of the frame.
    """
    types: Mapping[str, Any] = store().types
    stamp = types["builtin_interfaces/msg/Time"](stamp_ns // 1_000_000_000, stamp_ns % 1_000_000_000)
    return types["std_msgs/msg/Header"](stamp, frame_id)


_NONE = np.zeros(0)
_NONE.flags.writeable = False
