"""Inverse kinematics: branches of an arm with a spherical wrist, and the self-motion of a YuMi. Writes one SVG file."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np

from armlab import kinematics, plots, robots
from armlab.plots import space
from armlab.plots.style import look
from armlab.robots import Robot
from armlab.robots.robot import arm_length


def branches(robot: Robot, T_base_tool: np.ndarray) -> np.ndarray:
    """Return distinct configurations (N, n) of one pose, highest elbow last."""
    starts = np.random.default_rng(0).uniform(robot.q_min, robot.q_max, (200, robot.n))
    goals = np.broadcast_to(T_base_tool, (len(starts), 4, 4))
    found = kinematics.inverse(robot, goals, starts, starts=1)
    q = found.q[found.success]
    places = kinematics.link_transforms(robot, q)[:, 2:5, :3, 3].round(3)
    different = np.unique(places.reshape(len(q), -1), axis=0, return_index=True)[1]
    return q[different[np.argsort(places[different, 0, 2])]]


def main() -> None:
    """Draw the branches and the self-motion in one figure."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.5, 4.4), subplot_kw=space.PROJECTION)
    arm = robots.load("ur5e")
    T_base_tool = kinematics.forward(arm, np.deg2rad([150, -70, 100, -60, -70, 0]))
    plots.robot(arm, branches(arm, T_base_tool), frames=False, ax=left)
    yumi = robots.load("yumi_right")
    walk = kinematics.self_motion(yumi, yumi.q_home, length=2.0, points=15)
    back = kinematics.self_motion(yumi, yumi.q_home, length=2.0, points=15, direction=-1)
    plots.robot(yumi, np.concatenate([back.q[::-1], walk.q])[::3], frames=False, ax=right)
    for ax, robot, title in ((left, arm, "one pose: solution branches"), (right, yumi, "one pose: self-motion")):
        q = T_base_tool if robot is arm else kinematics.forward(yumi, yumi.q_home)
        plots.scene({"tool": q}, frames=0.15 * arm_length(robot), ax=ax)
        ax.set_axis_off()
        ax.set_title(title, fontsize=9.5)
        space.equal_scale(ax, 1.05)
    figure.savefig("inverse.svg")


if __name__ == "__main__":
    with look():
        main()
