"""Between joint orders and between the two sides of the gears: last axis joints, any leading axes.

A controller counts axes and angles in its own way; armlab counts from base to tool, each joint against the link before:

* order: ABB's axis 7 of a YuMi arm is the third joint (`abb_to_logical`, `logical_to_abb`);
* gears and rods: ``q = G q_motor`` (`motor_to_joint` and its three relatives). G has entries off the diagonal where a
  motor moves two joints. On the IRB 2400 a parallel rod drives the upper arm, and ABB's axis 3 is q_2 + q_3.

The order comes first: ``motor_to_joint(robot, abb_to_logical(robot, values))``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import numbers
from armlab.errors import RobotError, ShapeError
from armlab.robots.robot import Robot

__all__ = [
    "abb_to_logical",
    "joint_to_motor",
    "joint_torque_to_motor",
    "logical_to_abb",
    "motor_to_joint",
    "motor_torque_to_joint",
]


def abb_to_logical(robot: Robot, values: ArrayLike) -> np.ndarray:
    """Bring values in the order of ABB's axis numbers into kinematic order, base to tool.

    Parameters
    ----------
    robot : its `abb_axes` is the order: 1 2 7 3 4 5 6 for a YuMi arm.
    values : (..., n).

    Returns
    -------
    (..., n), a new array.
    """
    return _values(robot, values)[..., np.array(robot.abb_axes) - 1]


def logical_to_abb(robot: Robot, values: ArrayLike) -> np.ndarray:
    """Bring values in kinematic order into the order of ABB's axis numbers: the inverse of `abb_to_logical`.

    Parameters
    ----------
    robot : its `abb_axes` is the order.
    values : (..., n).

    Returns
    -------
    (..., n), a new array.
    """
    return _values(robot, values)[..., np.argsort(robot.abb_axes)]


def motor_to_joint(robot: Robot, values: ArrayLike) -> np.ndarray:
    """Bring motor positions, velocities or accelerations through the gears: ``q = G q_motor``.

    Parameters
    ----------
    robot : its `coupling` is G.
    values : (..., n) in kinematic order.

    Returns
    -------
    (..., n).
    """
    values = _values(robot, values)
    return _through(robot.coupling, values)


def joint_to_motor(robot: Robot, values: ArrayLike) -> np.ndarray:
    """Bring joint positions, velocities or accelerations to the motors: ``q_motor = G⁻¹ q``.

    Parameters
    ----------
    robot : its `coupling` is G.
    values : (..., n) in kinematic order.

    Returns
    -------
    (..., n).
    """
    values = _values(robot, values)
    return _through(np.linalg.inv(robot.coupling), values)


def motor_torque_to_joint(robot: Robot, tau_motor: ArrayLike) -> np.ndarray:
    """Bring motor torques to the joints with the power kept: ``tau = G⁻ᵀ tau_motor``.

    Parameters
    ----------
    robot : its `coupling` is G.
    tau_motor : (..., n) [N m] in kinematic order.

    Returns
    -------
    (..., n).
    """
    tau_motor = _values(robot, tau_motor)
    return _through(np.linalg.inv(robot.coupling).T, tau_motor)


def joint_torque_to_motor(robot: Robot, tau: ArrayLike) -> np.ndarray:
    """Bring joint torques to the motors with the power kept: ``tau_motor = Gᵀ tau``.

    Parameters
    ----------
    robot : its `coupling` is G.
    tau : (..., n) [N m] in kinematic order.

    Returns
    -------
    (..., n).
    """
    tau = _values(robot, tau)
    return _through(robot.coupling.T, tau)


def _through(matrix: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Multiply; what is missing of one motor is missing of the joints that it moves, not of the others."""
    known = np.isfinite(values)
    result = np.where(known, values, 0.0) @ matrix.T
    return np.where(~known @ (matrix.T != 0), np.nan, result)


def _values(robot: Robot, values: ArrayLike) -> np.ndarray:
    if not isinstance(robot, Robot):
        raise RobotError.no_robot(robot)
    result = numbers(values, f"values for robot {robot.name!r}", ShapeError)
    if result.shape[-1:] != (robot.n,):
        raise ShapeError(f"Expected values of shape (..., {robot.n}) for robot {robot.name!r}, got {result.shape}.")
    return result
