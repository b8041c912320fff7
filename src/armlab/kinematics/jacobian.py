"""The geometric Jacobian."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from armlab.errors import UnknownName
from armlab.robots import Robot

__all__ = ["jacobian"]


def jacobian(
    robot: Robot, q: ArrayLike, frame: Literal["base", "tool"] = "base", out: np.ndarray | None = None
) -> np.ndarray:
    """Return the Jacobian of the tool point: ``[v; w] = J(q) qd``.

    Column i is ``[z_i x (p - p_i); z_i]`` (revolute) or ``[z_i; 0]`` (prismatic). A wrench on the tool at the tool
    point, in the same axes, needs joint torques ``tau = J^T wrench`` to be balanced or gives them, by its sign.

    Parameters
    ----------
    robot : the arm.
    q : (..., n) joint positions [rad or m].
    frame : axes in which v and w are told, "base" or "tool"; the point is the tool's origin in both.
    out : (..., 6, n) array to write into, or None for a new one.

    Returns
    -------
    J : (..., 6, n), rows [v; w].

    Raises
    ------
    UnknownName
        When `frame` is neither "base" nor "tool".
    ShapeError
        When the last axis of `q` is not n long, or `out` does not fit.
    """
    if frame not in ("base", "tool"):
        raise UnknownName.among("Jacobian frame", frame, ("base", "tool"))
    return robot.chain.jacobian(q, frame == "tool", out)
