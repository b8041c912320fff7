"""Forward kinematics: the pose of the tool and of every link."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from armlab.errors import RobotError
from armlab.robots import Robot

__all__ = ["forward", "link_transforms"]


def forward(robot: Robot, q: ArrayLike, out: np.ndarray | None = None, threads: int = 1) -> np.ndarray:
    """Return the pose of the tool in the base.

    ``T_base_tool(q) = E_0 Z_1(q_1) E_1 ... Z_n(q_n) E_n``, mount and tool included.

    Parameters
    ----------
    robot : the arm.
    q : (..., n) joint positions [rad or m].
    out : (..., 4, 4) array to write into, or None for a new one. A large one that is used again saves a third of the
        time, which the system takes to give new memory.
    threads : how many share the poses, 1 to 256; the result is the same to the last bit.

    Returns
    -------
    T_base_tool : (..., 4, 4).

    Raises
    ------
    ShapeError
        When the last axis of `q` is not n long, or `out` does not fit.
    RobotError
        When something else comes in place of a robot, such as its name.
    ConfigError
        When `threads` is not an integer from 1 to 256.
    """
    try:
        chain = robot.chain
    except AttributeError:
        raise RobotError.no_robot(robot) from None
    return chain.forward(q, out, threads)


def link_transforms(robot: Robot, q: ArrayLike, out: np.ndarray | None = None) -> np.ndarray:
    """Return the poses of link frames 1 ... n in the base.

    ``T_base_i = E_0 Z_1(q_1) ... E_{i-1} Z_i(q_i)``: the z axis is joint axis i, and the frame moves with link i.

    Parameters
    ----------
    robot : the arm.
    q : (..., n) joint positions [rad or m].
    out : (..., n, 4, 4) array to write into, or None for a new one.

    Returns
    -------
    T_base_link : (..., n, 4, 4).

    Raises
    ------
    ShapeError
        When the last axis of `q` is not n long, or `out` does not fit.
    RobotError
        When something else comes in place of a robot, such as its name.
    """
    try:
        chain = robot.chain
    except AttributeError:
        raise RobotError.no_robot(robot) from None
    return chain.link_transforms(q, out)
