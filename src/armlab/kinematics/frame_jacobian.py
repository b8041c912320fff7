"""How the tool moves when the constant frames of an arm do: the derivative that calibration needs."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import numbers
from armlab.errors import RobotError, ShapeError
from armlab.kernels import Chain
from armlab.robots import Robot

__all__ = ["frame_jacobian", "frame_poses", "twist_jacobian"]


def frame_jacobian(robot: Robot, q: ArrayLike) -> np.ndarray:
    """Return how the tool moves when frame j of the arm becomes ``E_j Exp([v; w])``: ``J[..., j, :] @ [v; w]``.

    With ``P_j = E_0 Z_1(q_1) E_1 ... E_j = (R_j, p_j)`` the tool at p moves by ``R_j v + R_j w x (p - p_j)`` and turns
    by ``R_j w``. The columns of the joints are among these: that of joint j + 1 is column w_z (prismatic: v_z) of
    frame j.

    Parameters
    ----------
    robot : the arm.
    q : (..., n) joint positions [rad or m].

    Returns
    -------
    J : (..., 6, n+1, 6), rows [v; w] at the tool point in base axes.

    Raises
    ------
    RobotError : when something else comes in place of a robot. ShapeError : when the last axis of `q` is not n long.
    """
    if not isinstance(robot, Robot):
        raise RobotError.no_robot(robot)
    P = frame_poses(robot.chain, robot.frames, q)
    return twist_jacobian(P, P[..., -1, :3, 3])


def frame_poses(chain: Chain, frames: np.ndarray, q: ArrayLike) -> np.ndarray:
    """Return ``P_j = E_0 Z_1(q_1) E_1 ... Z_j(q_j) E_j``, the last of which is the tool.

    Parameters
    ----------
    chain : of the arm. frames : (n+1, 4, 4) its E_0 ... E_n. q : (..., n) joint positions [rad or m].

    Returns
    -------
    P : (..., n+1, 4, 4).
    """
    links = chain.link_transforms(q)
    P = np.empty((*links.shape[:-3], len(frames), 4, 4))
    P[..., 0, :, :] = frames[0]
    np.matmul(links, frames[1:], out=P[..., 1:, :, :])
    return P


def twist_jacobian(P: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Return how a point that is fixed to all that follows frame j moves and turns with the body twist of that frame.

    Parameters
    ----------
    P : (..., m, 4, 4) poses of the frames. point : (..., 3) in the same axes [m].

    Returns
    -------
    J : (..., 6, m, 6), rows [v; w].
    """
    P, point = numbers(P, "poses of frames", ShapeError), numbers(point, "a point [m]", ShapeError)
    if P.ndim < 3 or P.shape[-2:] != (4, 4) or point.shape[-1:] != (3,):
        raise ShapeError(f"Expected poses (..., m, 4, 4) and points (..., 3), got shapes {P.shape} and {point.shape}.")
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
