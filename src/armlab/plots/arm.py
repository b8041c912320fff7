"""3D figures of an arm: stick figure, workspace and manipulability ellipsoids."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from armlab import kinematics
from armlab._display import GREY
from armlab._numbers import flag, numbers
from armlab.errors import ConfigError, RobotError, ShapeError
from armlab.kinematics import ellipsoid, forward, link_transforms
from armlab.plots import space
from armlab.plots.style import JOINT_STYLES, MODEL, legend, look
from armlab.robots import Robot
from armlab.robots.robot import arm_length, bends

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d import Axes3D

_STICK = "#333333"
_FAINT = 8  # maximum number of configurations drawn besides the last one
_CORNERS = 20  # corners of a joint's cylinder
_UNIT = {"joint": (0.055, 0.018), "frame": 0.13}  # joint length and radius, frame length; relative to the arm


def robot(
    robot: Robot, q: ArrayLike | None = None, *, path: bool = False, frames: bool = True, ax: Any = None
) -> Axes3D:
    """Draw an arm as a stick figure, with revolute joints as cylinders and prismatic joints as boxes along their axes.

    Links follow the joint axes and their common normals through the origins of the link frames. A dashed line connects
    the base and the mount. Each joint has the same colour in all figures.

    Parameters
    ----------
    robot : the arm.
    q : configuration (n,), or configurations (N, n). The last configuration is drawn in full, and up to eight evenly
        spaced others are drawn as faint lines. Default: home posture.
    path : draw the tool path through all N configurations.
    frames : draw the base, flange and tool frames.
    ax : 3D Axes to draw into, for example with another arm; default: a new figure.

    Returns
    -------
    The Axes; coordinates are in the robot's base axes [m].

    Raises
    ------
    ShapeError : q has the wrong shape, is empty or not finite, or `ax` is not three-dimensional.
    RobotError : `robot` is not a Robot, for example a name.
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
    """Return the configurations (N, n) to draw; None means the home posture."""
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
    """Return the corners (N, 3) of the stick figure at q (n,) in base axes [m]: mount, joints, link corners, tool."""
    T, tool = link_transforms(robot, q), forward(robot, q)
    points = [robot.T_base_mount[:3, 3]]
    axis = np.zeros(3)  # the mount has no axis: the first link ends at the nearest point on axis 1
    for i in range(robot.n):
        origin, z = T[i, :3, 3], T[i, :3, 2]
        start = origin - q[i] * z if robot.prismatic[i] else origin  # start of the prismatic joint
        points += [*bends(points[-1], axis, start, z), start, origin]
        axis = z
    flange = (tool @ np.linalg.inv(robot.T_flange_tool))[:3, 3]
    points += [points[-1] + ((flange - points[-1]) @ axis) * axis, flange, tool[:3, 3]]
    points = np.array(points)
    return points[np.r_[True, np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-9]]


def _arm(ax: Axes3D, robot: Robot, q: np.ndarray) -> None:
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
    """Return the faces (3 x corners, 4, 3) of a prism about the z axis of T, centred at the origin of T."""
    angle = 2 * np.pi * (np.arange(corners + 1) + 0.5) / corners
    low, high = (
        np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(corners + 1, z)], axis=1)
        for z in (-length / 2, length / 2)
    )
    sides = np.stack([low[:-1], low[1:], high[1:], high[:-1]], axis=1)
    ends = [np.stack([end[:-1], end[1:], end[1:] * (0, 0, 1), end[:-1] * (0, 0, 1)], axis=1) for end in (low, high)]
    return np.concatenate([sides, *ends]) @ T[:3, :3].T + T[:3, 3]


def _frames(ax: Axes3D, robot: Robot, q: np.ndarray) -> None:
    """Draw the base, flange and tool frames; without a tool, the flange and tool frames coincide."""
    length = _UNIT["frame"] * arm_length(robot)
    T_base_tool = forward(robot, q)
    space.frame(ax, np.eye(4), length, "base")
    if not np.allclose(robot.T_flange_tool, np.eye(4)):
        space.frame(ax, T_base_tool @ np.linalg.inv(robot.T_flange_tool), 0.6 * length, "flange")
    space.frame(ax, T_base_tool, length, "tool", place=space.AHEAD)


_CLOUD = JOINT_STYLES[5][0]  # light, so that the arm stays visible


def workspace(robot: Robot, *, points: int = 20_000, seed: int = 0, ax: Any = None) -> Figure:
    """Draw the workspace of the tool point in side view (x, z), top view (x, y) and 3D, with the arm at home.

    Joint positions are sampled uniformly within the limits, and over one revolution for continuous joints. The point
    cloud is therefore sparse in regions that few configurations reach, and the actual workspace extends slightly beyond
    it.

    Parameters
    ----------
    robot : the arm.
    points : number of random configurations.
    seed : random seed; equal seeds give equal point clouds.
    ax : three Axes, of which the last is three-dimensional; default: a new figure.

    Returns
    -------
    The Figure. The title of the first panel gives the name of the robot, and the minimum and maximum distances of the
    tool from the mount.

    Raises
    ------
    RobotError : a prismatic joint has no limits, or `robot` is not a Robot.
    ShapeError : `points` is not a positive integer, or `ax` is not three Axes.
    ConfigError : `seed` is not a non-negative integer.
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
            panel.set_aspect("equal", adjustable="datalim")  # keeps panels at equal height
        side.set_title(f"{robot.name}\ntool {reach.min():.2f} to {reach.max():.2f} m from the mount")
        top.set_title(f"{points} random configurations")
        solid.scatter(*p.T, s=0.6, color=_CLOUD, alpha=0.25, depthshade=False, rasterized=True, gid="cloud")
        solid.plot(*arm.T, color="black", linewidth=2.0, gid="arm")
        space.equal_scale(solid, ticks=4)
    return figure


def _sample(robot: Robot, points: int, seed: int) -> np.ndarray:
    """Return tool positions (points, 3) in base axes [m] for random configurations within the limits."""
    if not isinstance(points, int | np.integer) or points < 1:
        raise ShapeError(f"Expected at least one point for the workspace of {robot.name}, got points={points!r}.")
    if not isinstance(seed, int | np.integer) or seed < 0:
        raise ConfigError(f"Expected seed to be an integer >= 0, got {seed!r}.")
    low = np.where(np.isinf(robot.q_min), -np.pi, robot.q_min)
    high = np.where(np.isinf(robot.q_max), np.pi, robot.q_max)
    endless = robot.prismatic & (np.isinf(robot.q_min) | np.isinf(robot.q_max))
    if endless.any():
        name = robot.joint_names[int(np.argmax(endless))]
        raise RobotError(
            f"Expected limits of the prismatic joint {name} of {robot.name}, got infinite limits. Set q_min, q_max."
        )
    q = np.random.default_rng(seed).uniform(low, high, (points, robot.n))
    return forward(robot, q)[:, :3, 3]


def _panels(ax: Any) -> tuple[Figure, tuple[Axes, Axes, Any]]:
    """Return a new figure, or that of the caller's Axes, and its three panels (side, top, space)."""
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
    solid.set_anchor("W")  # leaves room for the z label on the right
    return figure, (side, top, solid)


_SIZE = 0.22  # longest half-axis drawn, relative to the arm length
_MOST = 8
_UNITS = {"position": ("v", "m/s"), "rotation": ("w", "rad/s")}

_draw = robot  # alias for functions with a parameter named robot


def manipulability(
    robot: Robot, q: ArrayLike | None = None, part: Literal["position", "rotation"] = "position", *, ax: Any = None
) -> Axes3D:
    """Draw the velocity ellipsoid of the tool: the set of tool velocities for all joint velocities with norm 1.

    The ellipsoid is ``{J qd : |qd| = 1}``; see `kinematics.ellipsoid` and `kinematics.manipulability`. Along a short
    axis, the tool moves slowly and can exert large forces.

    Parameters
    ----------
    robot : the arm.
    q : configuration (n,), or configurations (N, n), of which at most eight, evenly spaced, are drawn. Default: home
        posture.
    part : "position" for the velocity of the tool point, or "rotation" for the angular velocity.
    ax : 3D Axes to draw into; default: a new figure.

    Returns
    -------
    The Axes. The title gives the half-axes at the last configuration, and the scale.

    Raises
    ------
    UnknownName : `part` is unknown.
    ShapeError, RobotError : as in `robot`.
    """
    q = configurations(robot, q)
    q = q[np.unique(np.linspace(0, len(q) - 1, min(_MOST, len(q))).astype(int))]
    found = ellipsoid(robot, q, part)
    scale = _SIZE * arm_length(robot) / (float(found.lengths.max()) or 1.0)
    with look():
        panel = _draw(robot, q, frames=False, ax=ax)
        for centre, axes, half in zip(forward(robot, q)[:, :3, 3], found.axes, found.lengths, strict=True):
            half_axes = scale * axes * half  # columns
            space.solid(panel, _ball() @ half_axes.T + centre, MODEL, alpha=0.2, zorder=3, gid="ellipsoid")
            for along in half_axes.T:
                panel.plot(*np.stack([centre - along, centre + along], axis=1), color=MODEL, gid="axis")
        letter, unit = _UNITS[part]
        numbers = ", ".join(f"{x:.3g}" for x in found.lengths[-1])
        panel.set_title(
            f"{letter} for joint speeds |qd| = 1: half-axes {numbers} {unit}\n"
            f"manipulability {kinematics.manipulability(robot, q[-1], part):.3g}; scale: 1 {unit} = {scale:.2g} m"
        )
        space.equal_scale(panel)
    return panel


def _ball(steps: int = 16) -> np.ndarray:
    """Return the faces (2 steps², 4, 3) of the unit sphere."""
    polar, round_ = np.linspace(0, np.pi, steps + 1), np.linspace(0, 2 * np.pi, 2 * steps + 1)
    a, b = np.meshgrid(polar, round_, indexing="ij")
    p = np.stack([np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.cos(a)], axis=-1)
    return np.stack([p[:-1, :-1], p[1:, :-1], p[1:, 1:], p[:-1, 1:]], axis=-2).reshape(-1, 4, 3)
