"""Steer a taught motion of a YuMi around a new pillar, offline and in the control loop.

Then retime the taught motion to velocity and acceleration limits.
"""

import numpy as np

from armlab import State, kinematics, motion, robots

ROBOT = robots.load("yumi_right")
DT = 0.004


def main() -> None:
    way = np.array([1.1, 0.1, 0.2, 0.2, -0.3, 0.4, 0.2])
    taught = motion.profiles.minimum_jerk(ROBOT.q_home, ROBOT.q_home + way, duration=2.0)
    dmp = motion.fit_dmp(taught.t, taught.q, scaling="none").value
    tip = kinematics.forward(ROBOT, taught.at(1.0)[0])[:3, 3]  # point on the tool path, after one second
    up = np.array([0.0, 0.0, 1.0])
    pillar = motion.Capsule(tip - 0.3 * up, tip + 0.02 * up, radius=0.02)
    gripper = motion.Capsule([0.0, 0.0, -0.08], [0.0, 0.0, 0.0], radius=0.01)  # in tool axes
    around = motion.AvoidingDmp(dmp, [pillar], clearance=0.015, reach=0.1, robot=ROBOT, tool=gripper)
    run = around.rollout(np.arange(0.0, 4.0, DT))
    least = [1e3 * around.distance(q).min() for q in (dmp.rollout(DT).y, run.y)]
    print(f"distance from the pillar: {least[0]:.0f} mm as taught, {least[1]:.1f} mm with avoidance")
    print(f"goal error {1e3 * abs(run.y[-1] - dmp.g).max():.3f} mrad")

    controller, q = around.controller(), ROBOT.q_home  # on a robot: link.run(controller)
    for k in range(1000):
        controller.place([pillar])  # obstacle position, for example from a camera
        q = controller(State(k * DT, DT, q, np.zeros(7), q)).q
    print(f"in the control loop: done {controller.done}")

    paced = motion.retimed(dmp, 0.5, 2.0, v0=np.zeros(7))  # rad/s, rad/s^2
    stretched = motion.shortest_duration(dmp, 0.5, 2.0, v0=np.zeros(7))
    print(f"duration within limits: {paced.duration:.2f} s, or {stretched:.2f} s if slowed uniformly")


if __name__ == "__main__":
    main()
