"""An arm as a stick figure."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import flag, numbers
from armlab.errors import RobotError, ShapeError
from armlab.kinematics import forward, link_transforms
from armlab.plots import space
from armlab.plots.style import GREY, JOINT_STYLES, legend, look
from armlab.robots import Robot
from armlab.robots.robot import arm_length, bends

if TYPE_CHECKING:
    from mpl_toolkits.mplot3d import Axes3D

__all__ = ["configurations", "robot", "stick"]

_STICK = "#333333"
_FAINT = 8  # most configurations drawn beside the last one
_CORNERS = 20  # of a joint's cylinder
_UNIT = {"joint": (0.055, 0.018), "frame": 0.13}  # length and radius of a joint, length of a frame: over the arm's


def robot(
    robot: Robot, q: ArrayLike | None = None, *, path: bool = False, frames: bool = True, ax: Any = None
) -> Axes3D:
    """Draw an arm as a stick figure: revolute joints as cylinders about their axes, prismatic ones as boxes along them.

    Links run along their joint axes and the common normals between them, through the origins of the link frames; the
    dashed line leads from the base to the mount. Joint i has the colour that it has in all figures.

    Parameters
    ----------
    robot : the arm.
    q : (n,) a configuration, or (N, n) several: the last one is drawn in full, of the others up to eight, evenly
        spaced, as faint lines. The robot's home when None.
    path : draw the path of the tool through all N configurations.
    frames : draw the frames base, flange and tool.
    ax : three-dimensional Axes to draw into, for example those of another arm; a new figure when None.

    Returns
    -------
    The Axes, in metres, base axes of the robot.

    Raises
    ------
    ShapeError : q does not have n numbers per configuration, has none, or one is not finite; `ax` is not
        three-dimensional.
    RobotError : something else came in place of a robot, such as its name.
    """
    q = configurations(robot, q)
    with look():
        figure, panel = space.space(ax)
        for k in np.unique(np.linspace(0, len(q) - 2, min(_FAINT, len(q) - 1)).astype(int)):
            panel.plot(*stick(robot, q[k]).T, color=GREY, alpha=0.3, linewidth=1.2, gid="faint")
        if flag(path, "path of a drawn arm"):
            panel.plot(*forward(robot, q)[:, :3, 3].T, color="black", linewidth=1.0, gid="path")
        _arm(panel, robot, q[-1])
        if flag(frames, "frames of a drawn arm"):
            _frames(panel, robot, q[-1])
        space.equal_scale(panel)
        if ax is None:
            legend(figure, panel)
    return panel


def configurations(robot: Robot, q: ArrayLike | None) -> np.ndarray:
    """Return the configurations (N, n) to draw; the robot's home for None.

    Raises
    ------
    ShapeError : the shape is neither (n,) nor (N, n), or a number is not finite.
    RobotError : something else came in place of a robot, such as its name.
    """
    if not isinstance(robot, Robot):
        raise RobotError.no_robot(robot)
    q = robot.q_home if q is None else numbers(q, "q", ShapeError)
    if q.ndim not in (1, 2) or q.shape[-1] != robot.n or not q.size:
        raise ShapeError(f"Expected q of shape ({robot.n},) or (N, {robot.n}) to draw {robot.name}, got {q.shape}.")
    q = np.atleast_2d(q)
    if not np.isfinite(q).all():
        raise ShapeError(f"Expected finite q to draw {robot.name}, got {q[~np.isfinite(q).all(axis=1)][0]}.")
    return q


def stick(robot: Robot, q: np.ndarray) -> np.ndarray:
    """Return the corners (N, 3) of the stick figure at q (n,), base axes [m]: mount, joints, bends of links, tool."""
    T, tool = link_transforms(robot, q), forward(robot, q)
    points = [robot.T_base_mount[:3, 3]]
    axis = np.zeros(3)  # the mount has none: the first link leads to the nearest point of axis 1
    for i in range(robot.n):
        origin, z = T[i, :3, 3], T[i, :3, 2]
        start = origin - q[i] * z if robot.prismatic[i] else origin  # where the slide begins
        points += [*bends(points[-1], axis, start, z), start, origin]
        axis = z
    flange = (tool @ np.linalg.inv(robot.T_flange_tool))[:3, 3]
    points += [points[-1] + ((flange - points[-1]) @ axis) * axis, flange, tool[:3, 3]]
    points = np.array(points)
    return points[np.r_[True, np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-9]]


def _arm(ax: Axes3D, robot: Robot, q: np.ndarray) -> None:
    """Draw one configuration in full."""
    mount = robot.T_base_mount[:3, 3]
    if mount.any():
        ax.plot(*np.stack([np.zeros(3), mount], axis=1), color=GREY, linewidth=1.0, linestyle="--", gid="mount")
    ax.plot(*stick(robot, q).T, color=_STICK, linewidth=2.5, solid_joinstyle="round", gid="arm")
    length, radius = (arm_length(robot) * part for part in _UNIT["joint"])
    for i, T in enumerate(link_transforms(robot, q)):
        if robot.prismatic[i]:
            T = T.copy()
            T[:3, 3] -= q[i] * T[:3, 2]
            faces = _prism(T, 1.8 * length, 1.4 * radius, 4)
        else:
            faces = _prism(T, length, radius, _CORNERS)
        color = JOINT_STYLES[i % len(JOINT_STYLES)][0]
        space.solid(ax, faces, color, gid=f"joint {i + 1}")
        ax.plot([], [], [], color=color, linewidth=5.0, label=robot.joint_names[i])


def _prism(T: np.ndarray, length: float, radius: float, corners: int) -> np.ndarray:
    """Return the faces (3 corners, 4, 3) of a prism about the z axis of T, centred at its origin."""
    angle = 2 * np.pi * (np.arange(corners + 1) + 0.5) / corners
    low, high = (
        np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(corners + 1, z)], axis=1)
        for z in (-length / 2, length / 2)
    )
    sides = np.stack([low[:-1], low[1:], high[1:], high[:-1]], axis=1)
    ends = [np.stack([end[:-1], end[1:], end[1:] * (0, 0, 1), end[:-1] * (0, 0, 1)], axis=1) for end in (low, high)]
    return np.concatenate([sides, *ends]) @ T[:3, :3].T + T[:3, 3]


def _frames(ax: Axes3D, robot: Robot, q: np.ndarray) -> None:
    """Draw base, flange and tool; without a tool, flange and tool are one frame."""
    length = _UNIT["frame"] * arm_length(robot)
    T_base_tool = forward(robot, q)
    space.frame(ax, np.eye(4), length, "base")
    if np.allclose(robot.T_flange_tool, np.eye(4)):
        space.frame(ax, T_base_tool, length, "tool", place=space.AHEAD)
    else:
        space.frame(ax, T_base_tool @ np.linalg.inv(robot.T_flange_tool), 0.6 * length, "flange")
        space.frame(ax, T_base_tool, length, "tool", place=space.AHEAD)
