"""The time derivative of the Jacobian."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from armlab.errors import RobotError, UnknownName
from armlab.robots import Robot

__all__ = ["jacobian_derivative"]


def jacobian_derivative(
    robot: Robot,
    q: ArrayLike,
    qd: ArrayLike,
    frame: Literal["base", "tool"] = "base",
    out: np.ndarray | None = None,
) -> np.ndarray:
    """Return the time derivative of the Jacobian along a motion: ``[vd; wd] = J(q) qdd + Jd(q, qd) qd``.

    It is the derivative of the numbers that `jacobian` returns for the same `frame`. In base axes `vd` and `wd` are the
    accelerations of the tool point and of the tool. In tool axes they are the rates of the velocities as the tool
    tells them: ``vd + w x v`` is then the acceleration of the tool point in tool axes, and `wd` the angular one.
    Pinocchio's ``getFrameJacobianTimeVariation`` with LOCAL_WORLD_ALIGNED and LOCAL gives the same two arrays.

    Parameters
    ----------
    robot : the arm.
    q : (..., n) joint positions [rad or m].
    qd : (..., n) joint velocities [rad/s or m/s], of the shape of `q`.
    frame : axes in which the Jacobian is told, "base" or "tool"; the point is the tool's origin in both.
    out : (..., 6, n) array to write into, or None for a new one.

    Returns
    -------
    Jd : (..., 6, n), rows [vd; wd].

    Raises
    ------
    UnknownName
        When `frame` is neither "base" nor "tool".
    ShapeError
        When the last axis of `q` is not n long, `qd` has another shape, or `out` does not fit.
    RobotError
        When something else comes in place of a robot, such as its name.
    """
    if not isinstance(frame, str) or frame not in ("base", "tool"):
        raise UnknownName.among("Jacobian frame", frame, ("base", "tool"))
    try:
        chain = robot.chain
    except AttributeError:
        raise RobotError.no_robot(robot) from None
    return chain.jacobian_derivative(q, qd, frame == "tool", out)
