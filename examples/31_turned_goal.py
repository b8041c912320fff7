"""Teach a tool motion by hand; repeat it to a shifted and rotated goal. The path rotates with the goal.

The demonstration is recorded from a simulated YuMi over EGM.
"""

import numpy as np

from armlab import bridge, kinematics, motion, plots, robots
from armlab.lie import so3

ROBOT = robots.load("yumi_right")
TURN = so3.exp([0.0, 0.0, np.deg2rad(50.0)])  # about the vertical
MOVE = np.array([0.02, 0.03, 0.0])  # m


def main() -> None:
    with bridge.connect("sim://yumi_right?program=lead-through&seed=3", ROBOT) as link:
        table = link.run(None, seconds=2.5).table  # in real time, as with a human hand
    shown = kinematics.forward(ROBOT, table["q"])
    fit = motion.fit_pose_dmp(table.t, shown, scaling="none", frame="goal")
    rms = np.sqrt((fit.residuals**2).mean(axis=0))
    print(f"taught: fit error {1e3 * rms[:3].max():.2f} mm and {1e3 * rms[3:].max():.2f} mrad (RMS)")

    goal = fit.value.T_goal.copy()
    goal[:3, :3] = TURN @ goal[:3, :3]
    goal[:3, 3] += MOVE
    controller = fit.value.controller(ROBOT, goal=goal)
    with bridge.connect("sim://yumi_right?lockstep=true", ROBOT) as link:
        table = link.run(controller, seconds=3.5).table
    repeated = kinematics.forward(ROBOT, table["q"])

    off, turned = repeated[-1, :3, 3] - goal[:3, 3], so3.angle(repeated[-1, :3, :3], goal[:3, :3])
    print(f"repeated: {1e3 * np.linalg.norm(off):.2f} mm and {1e3 * turned:.2f} mrad from the goal")
    plots.scene(shown, repeated, {"taught": fit.value.T_goal, "turned": goal}, frames=0.01).figure.savefig("turned.png")


if __name__ == "__main__":
    main()
