"""Figures of the page Conventions: frames, kinematic descriptions, signs. Writes SVG files."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from armlab import kinematics, plots, robots
from armlab._display import AXIS_COLORS, GREY
from armlab.lie import se3, so3
from armlab.plots import space
from armlab.plots.arm import stick as stick_of
from armlab.plots.style import MODEL, look
from armlab.robots import Robot

STICK = {"color": "#333333", "linewidth": 2.5}
BOLD = {"color": "black", "linewidth": 2.4, "mutation_scale": 14}
Q = np.deg2rad([20.0, -35.0, 60.0])  # posture of the small arm


def pose(x: float, y: float, z: float, w: tuple[float, float, float] = (0, 0, 0)) -> np.ndarray:
    """Return the pose at a position [m] with a rotation vector [degrees]."""
    return se3.from_rp(so3.exp(np.deg2rad(w)), (x, y, z))


def canvas(titles: tuple[str, ...], width: float, height: float, rows: int = 1, **view: float) -> Any:
    """Return a figure with 3-D panels, without axes boxes."""
    kw = {**space.PROJECTION, **view}
    figure, axes = plt.subplots(rows, len(titles) // rows, figsize=(width, height), subplot_kw=kw, squeeze=False)
    for ax, title in zip(axes.flat, titles, strict=True):
        ax.set_axis_off()
        ax.set_title(title, fontsize=9.5)
    return figure, axes.ravel()


def link(ax: Any, a: np.ndarray, b: np.ndarray, **style: Any) -> None:
    """Draw a line between two points or frame origins."""
    ends = [x[:3, 3] if x.ndim == 2 else x for x in (a, b)]
    ax.plot(*np.stack(ends, axis=1), **{"color": GREY, "linewidth": 0.9, "linestyle": "--", **style})


def frames() -> None:
    """World, base, flange, sensor, tool, camera and marker frames of a cell, with a detail of the wrist."""
    T_world_base, T_world_marker = pose(0.7, 0.6, 0.35), pose(1.9, 0.7, 0.0)
    T_flange_sensor, T_flange_tool = pose(0, 0, 0.1), pose(0.05, 0, 0.3, (0, 30, 0))
    arm = robots.load("irb2400").with_tool(T_flange_tool).with_base(T_world_base)
    q = np.deg2rad([25, 10, 10, 0, 40, 0])
    T_world_tool = kinematics.forward(arm, q)
    T_world_flange = T_world_tool @ se3.inv(T_flange_tool)
    T_world_cam = T_world_flange @ pose(-0.13, 0, 0.06, (0, 15, 0))
    T_world_sensor = T_world_flange @ T_flange_sensor
    figure, (cell, wrist) = canvas(("cell", "wrist"), 9.5, 4.5)
    plots.robot(arm, q, frames=False, ax=cell)
    named = {"world": np.eye(4), "base": T_world_base, "tool": T_world_tool, "marker": T_world_marker}
    plots.scene(named, frames=0.25, ax=cell)
    plots.scene({"cam": T_world_cam}, frames=0.17, ax=cell)
    link(wrist, T_world_flange, T_world_sensor, **STICK, linestyle="-")
    link(wrist, T_world_sensor, T_world_tool, **STICK, linestyle="-")
    named = {"flange": T_world_flange, "sensor": T_world_sensor, "tool": T_world_tool, "cam": T_world_cam}
    plots.scene(named, frames=0.08, ax=wrist)
    for ax in (cell, wrist):
        link(ax, T_world_flange, T_world_cam)
        space.equal_scale(ax, 0.98)
    figure.savefig("frames.svg")


def link_frames() -> None:
    """Base, mount and link frames 1 to 6 of an arm on a pedestal: z along the joint."""
    arm = robots.load("irb2400").with_base(pose(0, 0, 0.4))
    q = np.deg2rad([20, 20, -10, 40, 60, 0])
    figure, (ax,) = canvas(("",), 5.6, 5.2, azim=-60)
    plots.robot(arm, q, frames=False, ax=ax)
    space.frame(ax, np.eye(4), 0.22, "base")
    space.word(ax, (-0.25, 0, 0.4), "mount")
    for i, T in enumerate(kinematics.link_transforms(arm, q)):
        space.frame(ax, T, 0.16, letters=False)
        space.arrow(ax, T[:3, 3], 0.27 * T[:3, 2], color=AXIS_COLORS[2], linewidth=2.0)
        space.word(ax, T[:3, 3] + 0.33 * T[:3, 2], f"$z_{i + 1}$", color=AXIS_COLORS[2], fontsize=11)
    space.equal_scale(ax, 1.1)
    figure.savefig("link_frames.svg")


def yumi() -> None:
    """Both arms of a YuMi in the frame of its body."""
    figure, (ax,) = canvas(("",), 6.2, 5.2, azim=-38, elev=16)
    for side in ("left", "right"):
        arm = robots.load(f"yumi_{side}")
        plots.robot(arm, frames=False, ax=ax)
        space.frame(ax, arm.T_base_mount, 0.08)
        space.word(
            ax, arm.T_base_mount[:3, 3] + ((0, 0, 0.08) if side == "left" else (0, -0.08, -0.04)), f"mount, {side}"
        )
        space.frame(ax, kinematics.forward(arm, arm.q_home), 0.08, f"tool, {side}", place=(0, 0, 1.6))
    space.frame(ax, np.eye(4), 0.12, "base: the body", place=(0, 0, -0.25))
    space.equal_scale(ax, 1.0)
    figure.savefig("yumi.svg")


def small_arm() -> Robot:
    """Return a three-joint arm with offsets, from a standard DH table."""
    return robots.from_dh("three", np.deg2rad([-90.0, 0, 90]), [0.12, 0.4, 0.2], [0.35, 0.12, 0])


def chains() -> None:
    """Four kinematic descriptions of a three-joint arm."""
    titles = ("standard DH", "modified DH", "product of exponentials, at q = 0", "local product of exponentials")
    figure, axes = canvas(titles, 8.6, 7.2, rows=2)
    arm = small_arm()
    for ax, draw in zip(axes, (standard, modified, exponentials, local), strict=True):
        q = np.zeros(3) if draw is exponentials else Q
        plots.robot(arm, q, frames=False, ax=ax)
        draw(ax, arm, q)
        space.equal_scale(ax, 1.1)
    figure.savefig("chains.svg")


def standard(ax: Any, _arm: Robot, q: np.ndarray) -> None:
    """Frame j at the far end of link j: A_j = Rz(q_j) Tz(d_j) Tx(a_j) Rx(alpha_j)."""
    T = np.eye(4)
    space.frame(ax, T, 0.11, "0")
    for j, (d, a, alpha) in enumerate(((0.35, 0.12, -90), (0.12, 0.4, 0), (0, 0.2, 90))):
        T = T @ pose(0, 0, d, (0, 0, np.rad2deg(q[j]))) @ pose(a, 0, 0, (alpha, 0, 0))
        space.frame(ax, T, 0.11, str(j + 1), place=(-0.35, -0.35, 0.2))


def modified(ax: Any, _arm: Robot, q: np.ndarray) -> None:
    """Frame j on axis j: A_j = Rx(alpha_j) Tx(a_j) Rz(q_j) Tz(d_j)."""
    alpha, a, d = np.deg2rad([0, -90, 0]), [0, 0.12, 0.4], [0.35, 0.12, 0]
    arm = robots.from_dh("three", alpha, a, d, modified=True, T_flange_tool=pose(0.2, 0, 0, (90, 0, 0)))
    space.frame(ax, np.eye(4), 0.11, "0")
    T = np.eye(4)
    for j in range(3):
        T = T @ pose(a[j], 0, 0, (np.rad2deg(alpha[j]), 0, 0)) @ pose(0, 0, d[j], (0, 0, np.rad2deg(q[j])))
        space.frame(ax, T, 0.11, str(j + 1), place=(-0.35, -0.35, 0.2))
    ax.plot(*kinematics.forward(arm, q)[:3, 3, None], ".", color="black")


def exponentials(ax: Any, arm: Robot, q: np.ndarray) -> None:
    """All screws in base axes and the tool pose, at q = 0."""
    space.frame(ax, np.eye(4), 0.11, "base")
    space.frame(ax, arm.T_home, 0.11, "tool", place=(0, -0.3, -0.4))
    for j, (screw, T) in enumerate(zip(arm.screws, kinematics.link_transforms(arm, q))):
        axis(ax, T[:3, 3], screw[3:], j)
        link(ax, np.zeros(3), T, linestyle=":")


def local(ax: Any, arm: Robot, q: np.ndarray) -> None:
    """Each screw in the frame reached by its transform A."""
    poses, screws = robots.to_local_poe(arm)
    T = np.eye(4)
    space.frame(ax, T, 0.11, "base")
    for j, screw in enumerate(screws):
        T = T @ poses[j] @ se3.exp(q[j] * screw)
        space.frame(ax, T, 0.11, f"$A_{j + 1}$", place=(-0.35, -0.35, 0.2))
        w, point = T[:3, :3] @ screw[3:], T[:3, :3] @ np.cross(screw[3:], screw[:3]) + T[:3, 3]
        axis(ax, point, w, j)
        link(ax, T, point, linestyle=":")


def axis(ax: Any, point: np.ndarray, w: np.ndarray, j: int) -> None:
    """Draw a joint screw."""
    space.arrow(ax, point - 0.1 * w, 0.3 * w, color=MODEL, linewidth=2.0)
    space.word(ax, point + 0.26 * w, f"$\\xi_{j + 1}$", fontsize=12, color=MODEL)


def signs() -> None:
    """Twist of the tool, wrench of the environment on it, and weight of a load."""
    arm = small_arm()
    p = kinematics.forward(arm, Q)[:3, 3]
    titles = ("twist of the tool point: [v; w]", "contact wrench, on the robot: [f; m]", "an unmodelled load of 1 kg")
    figure, axes = canvas(titles, 9.5, 3.2)
    for ax in axes:
        plots.robot(arm, Q, frames=False, ax=ax)
        space.frame(ax, np.eye(4), 0.13, "base")
        ax.plot(*p[:, None], "o", color="black", markersize=4)
    twist, contact, load = axes
    space.arrow(twist, p, np.array([0.2, 0, -0.08]), **BOLD)
    space.word(twist, p + np.array([0.24, 0, -0.1]), "v", fontsize=11)
    turning(twist, p, "w")
    space.arrow(contact, p + np.array([0.25, 0, 0]), np.array([-0.23, 0, 0]), **BOLD)
    space.word(contact, p + np.array([0.13, 0, -0.12]), "f: a hand pushes\nalong −x, $f_x$ < 0", fontsize=8.5)
    turning(contact, p, "m")
    space.arrow(load, p, np.array([0, 0, -0.25]), **BOLD)
    space.word(load, p + np.array([0.05, 0, -0.32]), "$f_z$ = −9.81 N", fontsize=9.5)
    for ax in axes:
        ax.plot([-0.1, 0.8], [0.0, 0.0], [0.0, 0.75], alpha=0)  # same scale in all panels
        space.equal_scale(ax, 1.05)
    figure.savefig("signs.svg")


def turning(ax: Any, centre: np.ndarray, letter: str, radius: float = 0.07) -> None:
    """Draw a right-handed rotation about z as an open circle with an arrowhead."""
    angle = np.linspace(-0.3 * np.pi, 1.3 * np.pi, 60)
    circle = centre + np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(60, 0.1)], axis=1)
    ax.plot(*circle[:-3].T, color="black", linewidth=1.6)
    space.arrow(ax, circle[-6], circle[-1] - circle[-6], color="black", linewidth=1.6, mutation_scale=12)
    space.arrow(ax, centre, np.array([0, 0, 0.2]), color="black", linewidth=1.6)
    space.word(ax, centre + np.array([0, 0, 0.25]), letter, fontsize=11)


def jacobians() -> None:
    """One velocity of the tool point with its components in base axes and in tool axes."""
    arm = small_arm()
    T = kinematics.forward(arm, Q)
    v = np.array([0.16, 0.1, 0.14])
    figure, axes = canvas(('frame="base"', 'frame="tool"'), 9.0, 3.8)
    stick = stick_of(arm, Q)[-2:]
    for ax, R, name in zip(axes, (np.eye(3), T[:3, :3]), ("base axes", "tool"), strict=True):
        ax.plot(*stick.T, **STICK)
        space.frame(ax, se3.from_rp(R, T[:3, 3] if name == "tool" else stick[0] - (0.0, 0, 0.3)), 0.1, name)
        corner = T[:3, 3]
        for i, color in enumerate(AXIS_COLORS):
            part = (R[:, i] @ v) * R[:, i]
            link(ax, corner, corner + part, color=color, linewidth=2.2, linestyle="-")
            aside = corner + part / 2 - T[:3, 3] - v / 2
            place = corner + part / 2 + 0.058 * aside / np.linalg.norm(aside)
            space.word(ax, place, f"$v_{'xyz'[i]}$ = ${R[:, i] @ v:+.2f}$", color=color, fontsize=9)
            corner = corner + part
        space.arrow(ax, T[:3, 3], v, **BOLD)
        space.word(ax, T[:3, 3] + 1.1 * v, "v", fontsize=11)
        space.equal_scale(ax, 0.88)
    figure.savefig("jacobians.svg")


PICTURES: tuple[Callable[[], None], ...] = (frames, link_frames, yumi, chains, signs, jacobians)

if __name__ == "__main__":
    with look():
        for picture in PICTURES:
            picture()
