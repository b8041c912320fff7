"""Kinematic calibration: correct the geometry of an arm from fifty measured poses."""

import numpy as np

from armlab import calibrate, kinematics, plots, robots, sim


def main() -> None:
    arm = sim.cell(seed=1).kinematics()  # joint positions and measured tool poses, with ground truth
    fit = calibrate.fit_kinematics(arm.robot, arm.q, pose=arm.pose)
    print(fit.report())
    fit.save("arm.toml")
    robots.save(fit.value.robot, "corrected.toml")  # an ordinary Robot
    for name, robot in (("table", arm.robot), ("corrected", robots.load("corrected.toml"))):
        off = kinematics.forward(robot, arm.q_valid)[:, :3, 3] - arm.pose_valid[:, :3, 3]
        print(f"{name}: {1e3 * np.sqrt(np.mean(np.sum(off**2, axis=1))):.3f} mm RMS at held-out poses")
    plots.calibration(fit).savefig("kinematics.png", dpi=120)


if __name__ == "__main__":
    main()
