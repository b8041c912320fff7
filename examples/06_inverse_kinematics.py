"""Solve inverse kinematics within joint limits, use the redundancy, and handle an unreachable pose."""

import numpy as np

from armlab import kinematics, robots
from armlab.errors import NotConverged


def main() -> None:
    np.set_printoptions(precision=4, suppress=True)
    robot = robots.load("yumi_right")
    T_base_tool = kinematics.forward(robot, robot.q_home)
    T_base_tool[:3, 3] += [0.05, 0.02, 0.03]  # 5 cm forward, 2 cm sideways, 3 cm up

    found = kinematics.inverse(robot, T_base_tool, robot.q_home)
    print(found.report())
    print("joints [deg]:", np.rad2deg(found.q))

    q = np.random.default_rng(0).uniform(robot.q_min, robot.q_max, size=(2000, robot.n))
    goals = kinematics.forward(robot, q)
    print("batch:", kinematics.inverse(robot, goals, threads=2).report())

    for objective in ("posture", "mid_range", "limits", "manipulability"):  # 7 joints for a 6-DOF pose
        free = kinematics.inverse(robot, T_base_tool, objective=objective)
        room = np.min(1 - np.abs(2 * free.q - robot.q_max - robot.q_min) / (robot.q_max - robot.q_min))
        w = kinematics.manipulability(robot, free.q)
        print(f"{objective:15} smallest distance to a limit {room:.3f} of half the range, manipulability {w:.4f}")

    point = kinematics.inverse(robot, T_base_tool, task="axis", axis=[0.0, 0.0, 1.0])
    print("position and tool axis only:", point.report())

    T_base_tool[0, 3] = 1.5
    try:
        kinematics.inverse(robot, T_base_tool, strict=True)
    except NotConverged as error:
        print(error)


if __name__ == "__main__":
    main()
