"""Load a robot and compute poses and Jacobians, for one configuration or many."""

import numpy as np

from armlab import kinematics, robots
from armlab.lie import se3, so3


def main() -> None:
    robot = robots.load("yumi_right")
    np.set_printoptions(precision=4, suppress=True)
    print("library:", ", ".join(robots.names()))
    print(robot, "joint limits [deg]:", np.rad2deg(robot.q_min).round(1), np.rad2deg(robot.q_max).round(1))

    T_base_tool = kinematics.forward(robot, robot.q_home)  # in the body frame of the YuMi, metres
    print("tool pose at home\n", T_base_tool, sep="")

    J = kinematics.jacobian(robot, robot.q_home)  # rows [v; w], base axes, at the tool point
    qd = np.full(robot.n, 0.1)  # rad/s
    v, w = np.split(J @ qd, 2)
    print("tool velocity", v, "m/s, angular velocity", w, "rad/s")
    print("joint torques for a force of 5 N along x:", J.T @ [5.0, 0, 0, 0, 0, 0], "N m")

    q = np.random.default_rng(0).uniform(robot.q_min, robot.q_max, size=(100_000, robot.n))
    T = kinematics.forward(robot, q)  # (100000, 4, 4): all functions accept any leading axes
    reach = np.linalg.norm(T[:, :3, 3] - robot.T_base_mount[:3, 3], axis=1)
    print(f"{len(q)} random poses, tool {reach.min():.3f} to {reach.max():.3f} m from the shoulder")

    step = se3.log(se3.inv(T[0]) @ T[1])  # twist [v; w] from one pose to the other
    print("twist from pose 0 to pose 1:", step, "rotation angle", so3.angle(T[0, :3, :3], T[1, :3, :3]).round(4), "rad")


if __name__ == "__main__":
    main()
