"""Tasks and objectives of the inverse kinematics, by their names."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from armlab.errors import RobotError, UnknownName
from armlab.robots import Robot

__all__ = ["ROWS", "Objective", "Task", "check", "kernel_objective"]

Task = Literal["pose", "position", "axis", "direction"]
Objective = Literal["posture", "mid_range", "limits", "manipulability"]
ROWS = dict(zip(get_args(Task), (6, 3, 5, 2)))
_KINDS = dict(zip(get_args(Objective), (1, 1, 2, 3)))


def check(robot: object, task: str, objective: str | None) -> None:
    """Refuse names that are none, and what is no robot.

    Raises
    ------
    UnknownName
        When there is no such task or objective.
    RobotError
        When something else comes in place of a robot.
    """
    if task not in tuple(ROWS):  # what has no hash is unknown too
        raise UnknownName.among("inverse task", task, ROWS)
    if objective is not None and objective not in tuple(_KINDS):
        raise UnknownName.among("inverse objective", objective, _KINDS)
    if not isinstance(robot, Robot):
        raise RobotError.no_robot(robot)


def kernel_objective(
    robot: Robot, name: Objective | None, posture: ArrayLike | None
) -> tuple[int, ArrayLike | None, np.ndarray | None]:
    """Return the kernel's objective, reference and scale."""
    if name is None or name == "manipulability":
        return _KINDS.get(name or "", 0), None, None
    if name == "posture":
        return _KINDS[name], robot.q_home if posture is None else posture, np.ones(robot.n)
    ranges = (robot.q_max - robot.q_min) / 2.0
    limited = np.isfinite(ranges)  # a joint without limits may be anywhere
    return _KINDS[name], np.where(limited, robot.q_max - ranges, 0.0), np.where(limited, 1.0 / ranges, 0.0)
