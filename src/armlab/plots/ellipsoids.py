"""How fast the tool can move, in which direction."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from armlab import kinematics
from armlab.kinematics import ellipsoid, forward
from armlab.plots import space
from armlab.plots.arms import configurations
from armlab.plots.arms import robot as draw_arm
from armlab.plots.style import MODEL, look
from armlab.robots import Robot
from armlab.robots.robot import arm_length

if TYPE_CHECKING:
    from mpl_toolkits.mplot3d import Axes3D

__all__ = ["manipulability"]

_SIZE = 0.22  # largest half axis on paper over the length of the arm
_MOST = 8
_UNITS = {"position": ("v", "m/s"), "rotation": ("w", "rad/s")}


def manipulability(
    robot: Robot, q: ArrayLike | None = None, part: Literal["position", "rotation"] = "position", *, ax: Any = None
) -> Axes3D:
    """Draw the velocity ellipsoid at the tool: all velocities that joint speeds of total size 1 can give it.

    ``{J qd : |qd| = 1}``, see `kinematics.ellipsoid` and `kinematics.manipulability`. Where it is flat the tool cannot
    move, and can push hard.

    Parameters
    ----------
    robot : the arm.
    q : (n,) a configuration, or (N, n) several, of which at most eight, evenly spaced, are drawn. Home when None.
    part : "position", velocity of the tool point; or "rotation", angular velocity.
    ax : three-dimensional Axes to draw into; a new figure when None.

    Returns
    -------
    The Axes; the title holds the half axes at the last configuration and the scale.

    Raises
    ------
    UnknownName : another `part`.
    ShapeError, RobotError : as in `robot`.
    """
    q = configurations(robot, q)
    q = q[np.unique(np.linspace(0, len(q) - 1, min(_MOST, len(q))).astype(int))]
    found = ellipsoid(robot, q, part)
    scale = _SIZE * arm_length(robot) / (float(found.lengths.max()) or 1.0)
    with look():
        panel = draw_arm(robot, q, frames=False, ax=ax)
        for centre, axes, half in zip(forward(robot, q)[:, :3, 3], found.axes, found.lengths, strict=True):
            half_axes = scale * axes * half  # columns
            space.solid(panel, _ball() @ half_axes.T + centre, MODEL, alpha=0.2, zorder=3, gid="ellipsoid")
            for along in half_axes.T:
                panel.plot(*np.stack([centre - along, centre + along], axis=1), color=MODEL, gid="axis")
        letter, unit = _UNITS[part]
        numbers = ", ".join(f"{x:.3g}" for x in found.lengths[-1])
        panel.set_title(
            f"{letter} for joint speeds |qd| = 1: half axes {numbers} {unit}\n"
            f"manipulability {kinematics.manipulability(robot, q[-1], part):.3g}; 1 {unit} is drawn {scale:.2g} m long"
        )
        space.equal_scale(panel)
    return panel


def _ball(steps: int = 16) -> np.ndarray:
    """Return the faces (2 steps², 4, 3) of the unit ball."""
    polar, round_ = np.linspace(0, np.pi, steps + 1), np.linspace(0, 2 * np.pi, 2 * steps + 1)
    a, b = np.meshgrid(polar, round_, indexing="ij")
    p = np.stack([np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.cos(a)], axis=-1)
    return np.stack([p[:-1, :-1], p[1:, :-1], p[1:, 1:], p[:-1, 1:]], axis=-2).reshape(-1, 4, 3)
