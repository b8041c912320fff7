"""Forward kinematics and Jacobians: tool and link poses, geometric and parameter Jacobians, and derivatives."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from armlab.errors import RobotError, UnknownName
from armlab.kernels import Chain
from armlab.robots import Robot

Frame = Literal["base", "tool"]
_TOOL_AXES = {"base": False, "tool": True}


def forward(robot: Robot, q: ArrayLike, out: np.ndarray | None = None, threads: int = 1) -> np.ndarray:
    """Return the tool poses (..., 4, 4) in the base frame.

    ``T_base_tool(q) = E_0 Z_1(q_1) E_1 ... Z_n(q_n) E_n``, including mount and tool.

    Parameters
    ----------
    robot : the arm.
    q : (..., n) joint positions [rad or m].
    out : (..., 4, 4) output array; default: newly allocated. Reusing an array saves a third of the computing time for
        large batches.
    threads : number of threads, 1 to 256; the result is bitwise identical.

    Raises
    ------
    ShapeError : if the last axis of `q` does not have length n, or `out` does not match.
    RobotError : if `robot` is not a `Robot`.
    ConfigError : if `threads` is not an integer from 1 to 256.
    """
    try:
        chain = robot.chain
    except AttributeError:
        raise RobotError.no_robot(robot) from None
    return chain.forward(q, out, threads)


def link_transforms(robot: Robot, q: ArrayLike, out: np.ndarray | None = None) -> np.ndarray:
    """Return the poses (..., n, 4, 4) of link frames 1 ... n in the base frame.

    ``T_base_i = E_0 Z_1(q_1) ... E_{i-1} Z_i(q_i)``. Frame i moves with link i, and its z axis is joint axis i.

    Parameters
    ----------
    robot : the arm.
    q : (..., n) joint positions [rad or m].
    out : (..., n, 4, 4) output array; default: newly allocated.

    Raises
    ------
    ShapeError, RobotError : as in `forward`.
    """
    try:
        chain = robot.chain
    except AttributeError:
        raise RobotError.no_robot(robot) from None
    return chain.link_transforms(q, out)


def jacobian(
    robot: Robot, q: ArrayLike, frame: Frame = "base", out: np.ndarray | None = None, threads: int = 1
) -> np.ndarray:
    """Return the Jacobian (..., 6, n) of the tool point: ``[v; w] = J(q) qd``.

    Column i is ``[z_i x (p - p_i); z_i]`` (revolute) or ``[z_i; 0]`` (prismatic). A wrench on the tool, at the tool
    point and in the same axes, causes the joint torques ``tau = J^T wrench``.

    Parameters
    ----------
    robot : the arm.
    q : (..., n) joint positions [rad or m].
    frame : axes of v and w, "base" or "tool"; the reference point is always the tool origin.
    out : (..., 6, n) output array; default: newly allocated.
    threads : number of threads, 1 to 256; the result is bitwise identical.

    Raises
    ------
    UnknownName : if `frame` is not "base" or "tool".
    ShapeError, RobotError, ConfigError : as in `forward`.
    """
    chain, tool = _resolved(robot, frame)
    return chain.jacobian(q, tool, out, threads)


def forward_jacobian(
    robot: Robot,
    q: ArrayLike,
    frame: Frame = "base",
    out: tuple[np.ndarray, np.ndarray] | None = None,
    threads: int = 1,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the tool pose and Jacobian, ``T_base_tool(q)`` and ``J(q)``, in one pass along the arm.

    The results are bit-identical to those of `forward` and `jacobian`, and take little more time than `jacobian` alone.

    Parameters
    ----------
    robot : the arm.
    q : (..., n) joint positions [rad or m].
    frame : axes of the Jacobian, "base" or "tool"; the pose is always in the base frame.
    out : pair of output arrays (..., 4, 4) and (..., 6, n); default: newly allocated. Reusing arrays halves
        the time of large batches.
    threads : number of threads, 1 to 256; the result is bitwise identical.

    Returns
    -------
    T_base_tool : (..., 4, 4) tool pose in the base frame.
    J : (..., 6, n) Jacobian with rows [v; w].

    Raises
    ------
    UnknownName : if `frame` is not "base" or "tool".
    ShapeError : if the last axis of `q` does not have length n, or `out` is not a pair of separate arrays of matching
        shape.
    RobotError, ConfigError : as in `forward`.
    """
    chain, tool = _resolved(robot, frame)
    return chain.forward_jacobian(q, tool, out, threads)


def _resolved(robot: Robot, frame: Frame) -> tuple[Chain, bool]:
    """Return the compiled kinematic chain, and whether the axes are those of the tool."""
    try:
        return robot.chain, _TOOL_AXES[frame]
    except AttributeError:
        raise RobotError.no_robot(robot) from None
    except (KeyError, TypeError):  # TypeError: arrays and lists are unhashable
        raise UnknownName.among("Jacobian frame", frame, _TOOL_AXES) from None


def jacobian_derivative(
    robot: Robot, q: ArrayLike, qd: ArrayLike, frame: Literal["base", "tool"] = "base", out: np.ndarray | None = None
) -> np.ndarray:
    """Return the time derivative (..., 6, n) of the Jacobian: ``[vd; wd] = J(q) qdd + Jd(q, qd) qd``.

    This is the derivative of the array returned by `jacobian` for the same `frame`. In base axes, `vd` is the
    acceleration of the tool point and `wd` the angular acceleration of the tool. In tool axes, these vectors are the
    rates of the velocity components; the acceleration of the tool point is then ``vd + w x v``, and the angular
    acceleration is `wd`. The result equals Pinocchio's ``getFrameJacobianTimeVariation`` with LOCAL_WORLD_ALIGNED
    ("base") and LOCAL ("tool").

    Parameters
    ----------
    robot : the arm.
    q : (..., n) joint positions [rad or m].
    qd : (..., n) joint velocities [rad/s or m/s], with the shape of `q`.
    frame : axes of the Jacobian, "base" or "tool"; the reference point is always the tool origin.
    out : (..., 6, n) output array; default: newly allocated.

    Raises
    ------
    UnknownName : if `frame` is not "base" or "tool".
    ShapeError : if the last axis of `q` does not have length n, `qd` has a different shape, or `out` does not match.
    RobotError : if `robot` is not a `Robot`.
    """
    chain, tool = _resolved(robot, frame)
    return chain.jacobian_derivative(q, qd, tool, out)


def parameter_jacobian(robot: Robot, q: ArrayLike) -> np.ndarray:
    """Return the Jacobian (..., 6, n+1, 6) of the tool pose for perturbations ``E_j Exp([v; w])`` of all frames j.

    The tool twist due to frame j is ``J[..., j, :] @ [v; w]``. With ``P_j = E_0 Z_1(q_1) E_1 ... E_j = (R_j, p_j)``,
    the tool at p moves by ``R_j v + R_j w x (p - p_j)`` and rotates by ``R_j w``. Rows
    are [v; w] at the tool point in base axes. The position of joint j + 1 has the same effect as w_z (prismatic: v_z)
    of frame j.

    Parameters
    ----------
    robot : the arm.
    q : (..., n) joint positions [rad or m].

    Raises
    ------
    RobotError, ShapeError : as in `forward`.
    """
    if not isinstance(robot, Robot):
        raise RobotError.no_robot(robot)
    P = frame_poses(robot.chain, robot.frames, q)
    return twist_jacobian(P, P[..., -1, :3, 3])


def frame_poses(chain: Chain, frames: np.ndarray, q: ArrayLike) -> np.ndarray:
    """Return ``P_j = E_0 Z_1(q_1) E_1 ... Z_j(q_j) E_j`` (..., n+1, 4, 4); the last pose is that of the tool."""
    links = chain.link_transforms(q)
    P = np.empty((*links.shape[:-3], len(frames), 4, 4))
    P[..., 0, :, :] = frames[0]
    np.matmul(links, frames[1:], out=P[..., 1:, :, :])
    return P


def twist_jacobian(P: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Return the Jacobian (..., 6, m, 6) of a point (..., 3) with respect to body twists of frames P (..., m, 4, 4)."""
    R = P[..., :3, :3].swapaxes(-2, -3)
    lever = point[..., None, :] - P[..., :3, 3]
    x, y, z = lever[..., 0, None], lever[..., 1, None], lever[..., 2, None]
    J = np.zeros((*P.shape[:-3], 6, P.shape[-3], 6))
    J[..., :3, :, :3] = R
    J[..., 3:, :, 3:] = R
    J[..., 0, :, 3:] = R[..., 1, :, :] * z - R[..., 2, :, :] * y
    J[..., 1, :, 3:] = R[..., 2, :, :] * x - R[..., 0, :, :] * z
    J[..., 2, :, 3:] = R[..., 0, :, :] * y - R[..., 1, :, :] * x
    return J
