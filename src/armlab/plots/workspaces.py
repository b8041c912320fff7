"""Where the tool of an arm can be."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from armlab.errors import ConfigError, RobotError, ShapeError
from armlab.kinematics import forward
from armlab.plots import space
from armlab.plots.arms import stick
from armlab.plots.style import JOINT_STYLES, look
from armlab.robots import Robot

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["workspace"]

_CLOUD = JOINT_STYLES[5][0]  # light: the arm stays visible on it


def workspace(robot: Robot, *, points: int = 20_000, seed: int = 0, ax: Any = None) -> Figure:
    """Draw where the tool point can be: from the side (x, z), from above (x, y) and in space, with the arm at home.

    Joint positions are drawn uniformly inside the limits, so the cloud is thin where few postures lead; the rim of
    the true workspace lies a little outside it. Revolute joints without limits turn once.

    Parameters
    ----------
    robot : the arm.
    points : number of random postures.
    seed : of the random numbers; the same seed gives the same cloud.
    ax : three Axes, the last one three-dimensional; a new figure when None.

    Returns
    -------
    The Figure; its first title holds the name, and the smallest and largest distance of the tool from the mount.

    Raises
    ------
    RobotError : a prismatic joint has no limits, or something else came in place of a robot, such as its name.
    ShapeError : `points` is no integer of at least 1, or `ax` are not three Axes.
    ConfigError : `seed` is no integer of at least 0.
    """
    if not isinstance(robot, Robot):
        raise RobotError.no_robot(robot)
    p = _sample(robot, points, seed)
    reach = np.linalg.norm(p - robot.T_base_mount[:3, 3], axis=1)
    arm = stick(robot, robot.q_home)
    with look():
        figure, (side, top, solid) = _panels(ax)
        for panel, (i, j) in ((side, (0, 2)), (top, (0, 1))):
            panel.plot(p[:, i], p[:, j], ".", markersize=0.8, color=_CLOUD, alpha=0.35, rasterized=True, gid="cloud")
            panel.plot(arm[:, i], arm[:, j], color="black", linewidth=2.0, solid_joinstyle="round", gid="arm")
            panel.set(xlabel=f"{'xyz'[i]} [m]", ylabel=f"{'xyz'[j]} [m]")
            panel.set_aspect("equal", adjustable="datalim")  # panels of one height
        side.set_title(f"{robot.name}\ntool {reach.min():.2f} to {reach.max():.2f} m from the mount")
        top.set_title(f"{points} random postures")
        solid.scatter(*p.T, s=0.6, color=_CLOUD, alpha=0.25, depthshade=False, rasterized=True, gid="cloud")
        solid.plot(*arm.T, color="black", linewidth=2.0, gid="arm")
        space.equal_scale(solid, ticks=4)
    return figure


def _sample(robot: Robot, points: int, seed: int) -> np.ndarray:
    """Return places (points, 3) of the tool, base axes [m], for random postures inside the limits."""
    if not isinstance(points, int | np.integer) or points < 1:
        raise ShapeError(f"Expected at least one posture for the workspace of {robot.name}, got points={points!r}.")
    if not isinstance(seed, int | np.integer) or seed < 0:
        raise ConfigError(f"Expected seed to be an integer of at least 0, got {seed!r}.")
    low = np.where(np.isinf(robot.q_min), -np.pi, robot.q_min)
    high = np.where(np.isinf(robot.q_max), np.pi, robot.q_max)
    endless = robot.prismatic & (np.isinf(robot.q_min) | np.isinf(robot.q_max))
    if endless.any():
        name = robot.joint_names[int(np.argmax(endless))]
        raise RobotError(f"Expected limits of the prismatic joint {name} of {robot.name}, got none: reach is endless.")
    q = np.random.default_rng(seed).uniform(low, high, (points, robot.n))
    return forward(robot, q)[:, :3, 3]


def _panels(ax: Any) -> tuple[Figure, tuple[Axes, Axes, Any]]:
    """Return the figure and its three panels, from the side, from above, in space: new ones or the caller's."""
    if ax is not None:
        given = np.atleast_1d(np.asarray(ax, dtype=object)).ravel()
        if given.size != 3:
            raise ShapeError(f"Expected 3 Axes in ax=, the last one three-dimensional, got {given.size}.")
        figure, solid = space.space(given[2])
        return figure, (given[0], given[1], solid)
    import matplotlib.pyplot as plt

    figure = plt.figure(figsize=(11.0, 4.0))
    grid = figure.add_gridspec(1, 3, width_ratios=(1, 1, 1.5))
    side, top = figure.add_subplot(grid[0]), figure.add_subplot(grid[1])
    _, solid = space.space(figure.add_subplot(grid[2], **space.PROJECTION))
    solid.set_anchor("W")  # it is square in a wide panel: room for the label of z at the right
    return figure, (side, top, solid)
