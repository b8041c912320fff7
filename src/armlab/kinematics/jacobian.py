"""The geometric Jacobian, alone and with the pose."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from armlab.errors import RobotError, UnknownName
from armlab.robots import Robot

__all__ = ["forward_jacobian", "jacobian"]

Frame = Literal["base", "tool"]
_TOOL_AXES = {"base": False, "tool": True}


def jacobian(
    robot: Robot, q: ArrayLike, frame: Frame = "base", out: np.ndarray | None = None, threads: int = 1
) -> np.ndarray:
    """Return the Jacobian of the tool point: ``[v; w] = J(q) qd``.

    Column i is ``[z_i x (p - p_i); z_i]`` (revolute) or ``[z_i; 0]`` (prismatic). A wrench that acts on the
    tool at the tool point, in the same axes, acts on the joints with the torques ``tau = J^T wrench``.

    Parameters
    ----------
    robot : the arm.
    q : (..., n) joint positions [rad or m].
    frame : axes in which v and w are told, "base" or "tool"; the point is the tool's origin in both.
    out : (..., 6, n) array to write into, or None for a new one.
    threads : how many share the poses, 1 to 256; the result is the same to the last bit.

    Returns
    -------
    J : (..., 6, n), rows [v; w].

    Raises
    ------
    UnknownName
        When `frame` is neither "base" nor "tool".
    ShapeError
        When the last axis of `q` is not n long, or `out` does not fit.
    RobotError
        When something else comes in place of a robot, such as its name.
    ConfigError
        When `threads` is not an integer from 1 to 256.
    """
    try:
        chain, tool = robot.chain, _TOOL_AXES[frame]
    except AttributeError:
        raise RobotError.no_robot(robot) from None
    except (KeyError, TypeError):  # TypeError: arrays and lists have no hash
        raise _unknown(frame) from None
    return chain.jacobian(q, tool, out, threads)


def forward_jacobian(
    robot: Robot,
    q: ArrayLike,
    frame: Frame = "base",
    out: tuple[np.ndarray, np.ndarray] | None = None,
    threads: int = 1,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the pose of the tool and its Jacobian, ``T_base_tool(q)`` and ``J(q)``, in one walk along the arm.

    The numbers are those of `forward` and `jacobian` to the last bit, in little more than the time of one of them.

    Parameters
    ----------
    robot : the arm.
    q : (..., n) joint positions [rad or m].
    frame : axes of the Jacobian, "base" or "tool"; the pose is in the base in both.
    out : pair of arrays (..., 4, 4) and (..., 6, n) to write into, or None for new ones. Large ones that are used again
        save half of the time, which the system takes to give new memory.
    threads : how many share the poses, 1 to 256; the result is the same to the last bit.

    Returns
    -------
    T_base_tool : (..., 4, 4).
    J : (..., 6, n), rows [v; w].

    Raises
    ------
    UnknownName
        When `frame` is neither "base" nor "tool".
    ShapeError
        When the last axis of `q` is not n long, or `out` is no pair of arrays that fit and share no memory.
    RobotError
        When something else comes in place of a robot, such as its name.
    ConfigError
        When `threads` is not an integer from 1 to 256.
    """
    try:
        chain, tool = robot.chain, _TOOL_AXES[frame]
    except AttributeError:
        raise RobotError.no_robot(robot) from None
    except (KeyError, TypeError):
        raise _unknown(frame) from None
    return chain.forward_jacobian(q, tool, out, threads)


def _unknown(frame: object) -> UnknownName:
    return UnknownName.among("Jacobian frame", frame, _TOOL_AXES)
