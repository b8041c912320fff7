"""`Arm`: one arm in one row, with what several of its messages need worked out once."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from struct import Struct
from typing import Any

import numpy as np

from armlab import kinematics
from armlab.bridge.ros.types import store
from armlab.lie import quaternion
from armlab.robots import Robot

__all__ = ["Arm", "header"]


class Arm:
    """One arm in one row.

    Parameters
    ----------
    robot : the arm. places : of its fields, see `row.places`. data : the row. wall_ns : its wall clock.
    """

    __slots__ = ("_T_base_tool", "_data", "_places", "robot", "wall_ns")

    def __init__(self, robot: Robot, places: Mapping[str, tuple[Struct, int]], data: bytes, wall_ns: int) -> None:
        self.robot, self.wall_ns = robot, wall_ns
        self._places, self._data = places, data
        self._T_base_tool: np.ndarray | None = None

    def __getitem__(self, name: str) -> tuple[Any, ...]:
        """Return the numbers of a field of the row, named without the robot."""
        form, offset = self._places[name]
        return form.unpack_from(self._data, offset)

    def numbers(self, name: str) -> tuple[float, ...]:
        """Return the numbers of a field, or none when it is not there (one is NaN)."""
        form, offset = self._places[name]
        values = form.unpack_from(self._data, offset)
        if math.isnan(sum(values)) and any(map(math.isnan, values)):  # a sum of infinities is NaN, too
            return ()
        return values

    @property
    def T_base_tool(self) -> np.ndarray:
        """(4, 4) by the measured joints."""
        if self._T_base_tool is None:
            self._T_base_tool = kinematics.forward(self.robot, self["q"])
        return self._T_base_tool

    @property
    def tool_quaternion(self) -> np.ndarray:
        """Orientation of the tool in base axes, w x y z."""
        return quaternion.from_matrix(self.T_base_tool[:3, :3])

    def in_tool_axes(self, wrench: Sequence[float]) -> tuple[float, ...]:
        """Return a wrench of six numbers, of base axes at the tool point, in the axes of the tool."""
        (a, b, c, _), (d, e, f, _), (g, h, i, _), _ = self.T_base_tool.tolist()
        x, y, z, u, v, w = wrench
        return (
            a * x + d * y + g * z, b * x + e * y + h * z, c * x + f * y + i * z,
            a * u + d * v + g * w, b * u + e * v + h * w, c * u + f * v + i * w,
        )  # fmt: skip

    def covariance_in_tool_axes(self, cov: np.ndarray) -> np.ndarray:
        """Return the covariance (6, 6) of a wrench in the axes of the tool."""
        both = np.kron(np.eye(2), self.T_base_tool[:3, :3])
        return both.T @ cov @ both


def header(stamp_ns: int, frame_id: str = "") -> Any:
    """Return a std_msgs/msg/Header.

    Parameters
    ----------
    stamp_ns : wall clock. frame_id : name of the frame.
    """
    types: Mapping[str, Any] = store().types
    stamp = types["builtin_interfaces/msg/Time"](stamp_ns // 1_000_000_000, stamp_ns % 1_000_000_000)
    return types["std_msgs/msg/Header"](stamp, frame_id)
