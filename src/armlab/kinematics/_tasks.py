"""Tasks and objectives of the inverse kinematics, by their names."""

from __future__ import annotations

from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from armlab.errors import ConfigError, RobotError, UnknownName
from armlab.robots import Robot

__all__ = ["ROWS", "Objective", "Task", "check", "check_search", "kernel_objective"]

Task = Literal["pose", "position", "axis", "direction"]
Objective = Literal["posture", "mid_range", "limits", "manipulability"]
ROWS = dict(zip(get_args(Task), (6, 3, 5, 2)))
MOST_STEPS = 10**6  # from one start; a history of them takes 16 MB per goal
_KINDS = dict(zip(get_args(Objective), (1, 1, 2, 3)))
_INTEGER, _NUMBER = (int, np.integer), (int, float, np.integer, np.floating)


def check(robot: object, task: str, objective: str | None) -> None:
    """Refuse names that are none, and what is no robot.

    Raises
    ------
    UnknownName
        When there is no such task or objective.
    RobotError
        When something else comes in place of a robot.
    """
    if not isinstance(task, str) or task not in ROWS:
        raise UnknownName.among("task of inverse kinematics", task, ROWS)
    if objective is not None and (not isinstance(objective, str) or objective not in _KINDS):
        raise UnknownName.among("objective of inverse kinematics", objective, _KINDS)
    if not isinstance(robot, Robot):
        raise RobotError.no_robot(robot)


def check_search(tol: Any, maxiter: Any, starts: Any, damping: Any) -> tuple[float, float]:
    """Return the tolerances of position and rotation; refuse numbers that make no sense.

    Raises
    ------
    ConfigError
        When one is of another kind or out of its range.
    """
    if not (isinstance(maxiter, _INTEGER) and 0 <= maxiter <= MOST_STEPS):
        raise ConfigError(f"Expected maxiter to be an integer from 0 to {MOST_STEPS}, got {maxiter!r}.")
    if not (isinstance(starts, _INTEGER) and 1 <= starts < 2**31):
        raise ConfigError(f"Expected starts to be an integer of at least 1, got {starts!r}.")
    if not (isinstance(damping, _NUMBER) and 0 < damping < np.inf):
        raise ConfigError(f"Expected damping to be a number above 0, got {damping!r}.")
    position, rotation = tol if isinstance(tol, tuple) and len(tol) == 2 else (tol, tol)
    if not (isinstance(position, _NUMBER) and isinstance(rotation, _NUMBER) and position >= 0 and rotation >= 0):
        raise ConfigError(f"Expected tol to be a number of at least 0, or (position, rotation), got {tol!r}.")
    return float(position), float(rotation)


def kernel_objective(
    robot: Robot, name: Objective | None, posture: ArrayLike | None, q0: ArrayLike | None
) -> tuple[int, ArrayLike | None, np.ndarray | None]:
    """Return the kernel's objective, reference and scale.

    Raises
    ------
    ConfigError
        When a posture comes without the objective that it is for.
    """
    if posture is not None and name != "posture":
        raise ConfigError(f'Expected objective="posture" with a posture, got objective={name!r}. Leave one out.')
    if name is None or name == "manipulability":
        return _KINDS.get(name or "", 0), None, None
    if name == "posture":
        wanted = next((given for given in (posture, q0) if given is not None), robot.q_home)
        return _KINDS[name], wanted, np.ones(robot.n)
    ranges = (robot.q_max - robot.q_min) / 2.0
    limited = np.isfinite(ranges)  # a joint without limits may be anywhere
    return _KINDS[name], np.where(limited, robot.q_max - ranges, 0.0), np.where(limited, 1.0 / ranges, 0.0)
