"""Follow a tool path on one branch of the inverse kinematics; compute manipulability and a self-motion."""

import numpy as np

from armlab import kinematics, robots
from armlab.lie import so3

PERIOD = 0.004  # s between rows


def main() -> None:
    np.set_printoptions(precision=3, suppress=True)
    robot = robots.load("yumi_right")
    angle = np.linspace(0, 2 * np.pi, 1001)  # circle of radius 8 cm in 4 s; the tool tilts back and forth
    T_base_tool = np.tile(kinematics.forward(robot, robot.q_home), (len(angle), 1, 1))
    T_base_tool[:, 1, 3] += 0.08 * np.sin(angle)
    T_base_tool[:, 2, 3] += 0.08 * (1 - np.cos(angle))
    T_base_tool[:, :3, :3] @= so3.exp(0.2 * np.sin(angle)[:, None] * [1, 0, 0])
    T_base_tool[-1] = T_base_tool[0]

    path = kinematics.inverse_path(robot, T_base_tool, robot.q_home, max_step=PERIOD * robot.qd_max)
    print(path.report())
    print("minimum motion: joint displacement after one circle", np.rad2deg(path.q[-1] - path.q[0]), "deg")
    closed = kinematics.inverse_path(robot, T_base_tool, robot.q_home, objective="posture")
    print("posture objective: joint displacement", np.rad2deg(closed.q[-1] - closed.q[0]).round(6) + 0.0, "deg")

    qd = np.gradient(closed.q, PERIOD, axis=0)
    w = kinematics.manipulability(robot, closed.q)
    print(f"fastest joint {np.abs(qd).max():.2f} rad/s, manipulability {w.min():.4f} to {w.max():.4f}")
    Jd = kinematics.jacobian_derivative(robot, closed.q, qd)
    v_dot = (Jd @ qd[..., None])[:, :3, 0]  # m/s^2
    print(f"tool acceleration at constant joint velocity: up to {np.linalg.norm(v_dot, axis=1).max():.3f} m/s^2")

    walk = kinematics.self_motion(robot, robot.q_home, direction=1, length=3.0)
    print(f"self-motion of {walk.s[-1]:.2f} rad, end: {walk.end}; tool error {walk.position_error.max():.1g} m")


if __name__ == "__main__":
    main()
