"""Carry a box with both arms of a YuMi: the box follows a path, and each tool keeps its grasp."""

import numpy as np

from armlab import Command, State, bridge, kinematics, motion, plots, robots
from armlab.lie import se3, so3

ARMS = [robots.load("yumi_left"), robots.load("yumi_right")]
SECONDS, STEP = 4.0, 0.004  # s


def main() -> None:
    T_base_tools = [kinematics.forward(robot, robot.q_home) for robot in ARMS]
    T_base_box = se3.from_rp(np.eye(3), np.mean([T[:3, 3] for T in T_base_tools], axis=0))
    T_box_tools = [se3.inv(T_base_box) @ T for T in T_base_tools]  # grasp poses relative to the box
    T_base_goal = T_base_box @ se3.from_rp(so3.exp([0.0, 0.0, np.deg2rad(20)]), [0.05, 0.0, 0.1])
    way = motion.profiles.minimum_jerk([0.0], [1.0], duration=SECONDS).at(np.arange(0.0, SECONDS, STEP))[0]
    T_base_boxes = se3.interpolate(T_base_box, T_base_goal, way[:, 0].clip(0, 1))
    paths = [
        kinematics.inverse_path(r, T_base_boxes @ T, r.q_home, objective="posture") for r, T in zip(ARMS, T_box_tools)
    ]

    def carry(state: State) -> tuple[Command, ...]:
        return tuple(Command(path.q[min(int(state.t / STEP), len(way) - 1)]) for path in paths)

    with bridge.connect("sim://yumi_left+yumi_right?lockstep=true", ARMS) as link:
        table = link.run(carry, seconds=SECONDS + 1.0).table
    T_base_left, T_base_right = (kinematics.forward(robot, table[f"{robot.name}.q"]) for robot in ARMS)
    T_left_right = se3.inv(T_base_left) @ T_base_right
    slip = np.linalg.norm(T_left_right[:, :3, 3] - T_left_right[0, :3, 3], axis=1).max()
    print(f"relative error of the two grasps: at most {1e3 * slip:.2f} mm")
    T_base_end = T_base_left[-1] @ se3.inv(T_box_tools[0])
    print(f"box: {1e3 * np.linalg.norm((T_base_end - T_base_goal)[:3, 3]):.2f} mm from its goal")
    ax = plots.robot(ARMS[0], table["yumi_left.q"][-1], frames=False)
    plots.robot(ARMS[1], table["yumi_right.q"][-1], frames=False, ax=ax)
    plots.scene({"box": T_base_box, "goal": T_base_end}, T_base_left, T_base_right, ax=ax).figure.savefig("carry.png")


if __name__ == "__main__":
    main()
