"""Dynamics of an arm: gravity torques, energy, and computed-torque control with a force at the tool."""

import numpy as np

from armlab import dynamics, robots


def main() -> None:
    robot = robots.load("iiwa14")
    q, qd = np.array(robot.q_home), np.zeros(robot.n)
    print("gravity torques", dynamics.gravity(robot, q).round(2), "N m")
    print("inertia of joint 1:", dynamics.mass_matrix(robot, q)[0, 0].round(3), "kg m^2")

    # computed torque: every joint error follows e'' + 10 e' + 25 e = 0
    goal, dt, push = q + 0.3, 1e-3, np.array([0.0, 0.0, -1.0, 0.0, 0.0, 0.0])
    for k in range(3000):
        wanted = 25.0 * (goal - q) - 10.0 * qd
        tau = dynamics.inverse_dynamics(robot, q, qd, wanted)
        pushed = push if k > 2000 else None  # 1 N downwards at the tool in the last second
        qd = qd + dt * dynamics.forward_dynamics(robot, q, qd, tau, f_ext=pushed)
        q = q + dt * qd
        if k == 2000:
            print("largest error before the push", np.abs(goal - q).max().round(6), "rad")
    print("largest error during the push", np.abs(goal - q).max().round(4), "rad")

    kinetic, potential = dynamics.energy(robot, q, qd)
    print("energy", kinetic.round(4), "+", potential.round(2), "J")

    by_q, by_qd, _ = dynamics.forward_dynamics_derivatives(robot, q, qd, dynamics.gravity(robot, q))
    poles = np.linalg.eigvals(np.block([[np.zeros_like(by_q), np.eye(robot.n)], [by_q, by_qd]]))
    print("largest pole magnitude without control:", np.abs(poles).max().round(2), "rad/s")


if __name__ == "__main__":
    main()
