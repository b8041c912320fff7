"""Conversions between joint orders and between the motor and joint sides of the gears, along the last array axis.

armlab numbers joints from base to tool, and measures each joint relative to its parent link. Controllers use other
conventions:

* order: ABB's axis 7 of a YuMi arm is the third joint (`abb_to_logical`, `logical_to_abb`);
* gears and rods: ``q = G q_motor`` (`motor_to_joint` and the three related functions). G has off-diagonal entries if a
  motor moves two joints. On the IRB 2400, a parallel rod drives the upper arm, and ABB's axis 3 is q_2 + q_3.

Convert the order first: ``motor_to_joint(robot, abb_to_logical(robot, values))``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import numbers
from armlab.errors import RobotError, ShapeError
from armlab.robots.robot import Robot

__all__ = [
    "abb_to_logical", "joint_to_motor", "joint_torque_to_motor", "logical_to_abb", "motor_to_joint",
    "motor_torque_to_joint",
]  # fmt: skip


def abb_to_logical(robot: Robot, values: ArrayLike) -> np.ndarray:
    """Reorder values from ABB's axis numbers to kinematic order, base to tool.

    Parameters
    ----------
    robot : robot whose `abb_axes` defines the order: 1 2 7 3 4 5 6 for a YuMi arm.
    values : (..., n); the result is a new array of this shape.
    """
    return _values(robot, values)[..., np.array(robot.abb_axes) - 1]


def logical_to_abb(robot: Robot, values: ArrayLike) -> np.ndarray:
    """Reorder values from kinematic order to ABB's axis numbers; inverse of `abb_to_logical`.

    Parameters
    ----------
    robot : robot whose `abb_axes` defines the order.
    values : (..., n); the result is a new array of this shape.
    """
    return _values(robot, values)[..., np.argsort(robot.abb_axes)]


def motor_to_joint(robot: Robot, values: ArrayLike) -> np.ndarray:
    """Convert motor positions, velocities or accelerations to joints: ``q = G q_motor`` (..., n).

    Parameters
    ----------
    robot : robot whose `coupling` is G.
    values : (..., n) in kinematic order.
    """
    values = _values(robot, values)
    return _through(robot.coupling, values)


def joint_to_motor(robot: Robot, values: ArrayLike) -> np.ndarray:
    """Convert joint positions, velocities or accelerations to those of the motors: ``q_motor = G⁻¹ q`` (..., n).

    Parameters
    ----------
    robot : robot whose `coupling` is G.
    values : (..., n) in kinematic order.
    """
    values = _values(robot, values)
    return _through(np.linalg.inv(robot.coupling), values)


def motor_torque_to_joint(robot: Robot, tau_motor: ArrayLike) -> np.ndarray:
    """Convert motor torques to joint torques, preserving power: ``tau = G⁻ᵀ tau_motor`` (..., n).

    Parameters
    ----------
    robot : robot whose `coupling` is G.
    tau_motor : (..., n) [N m] in kinematic order.
    """
    tau_motor = _values(robot, tau_motor)
    return _through(np.linalg.inv(robot.coupling).T, tau_motor)


def joint_torque_to_motor(robot: Robot, tau: ArrayLike) -> np.ndarray:
    """Convert joint torques to motor torques, preserving power: ``tau_motor = Gᵀ tau`` (..., n).

    Parameters
    ----------
    robot : robot whose `coupling` is G.
    tau : (..., n) [N m] in kinematic order.
    """
    tau = _values(robot, tau)
    return _through(robot.coupling.T, tau)


def _through(matrix: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the matrix-vector product; a missing value (NaN) affects only the joints or motors coupled to it."""
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
