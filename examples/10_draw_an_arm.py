"""Plot an arm: its frames, a motion, its workspace and its velocity ellipsoids."""

import numpy as np

from armlab import kinematics, plots, robots
from armlab.lie import se3


def main() -> None:
    robot = robots.load("irb2400").with_tool(se3.from_rp(np.eye(3), [0.0, 0.0, 0.25]))
    t = np.linspace(0.0, 2.0, 100)  # s
    q = robot.q_home + np.outer(t, [0.6, 0.3, -0.15, 0.4, 0.4, 0.8])  # rad
    T_base_tool = kinematics.forward(robot, q)

    ax = plots.robot(robot, q, path=True)  # the last configuration is solid, the others are faint
    plots.scene({"marker": se3.from_rp(np.eye(3), [1.2, 0.9, 0.0])}, frames=0.2, ax=ax)
    ax.figure.savefig("arm.png", dpi=120)

    plots.poses(T_base_tool, t).savefig("poses.png", dpi=120)
    plots.scene(T_base_tool, frames=0.08).figure.savefig("path.png", dpi=120)
    plots.manipulability(robot, q[[0, -1]]).figure.savefig("ellipsoids.png", dpi=120)
    plots.workspace(robot, points=20_000, seed=1).savefig("workspace.png", dpi=120)

    ax = plots.robot(robots.load("yumi_left"))  # both arms in one scene, in the body frame
    plots.robot(robots.load("yumi_right"), ax=ax)
    ax.figure.savefig("yumi.png", dpi=120)
    print("figures (.png): arm, poses, path, ellipsoids, workspace, yumi")


if __name__ == "__main__":
    main()
