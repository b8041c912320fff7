"""Draw circles on a table with constant force, estimated from motor torques (simulated arm and elastic table).

Run 03_identify.py first; it writes model.toml.
"""

import numpy as np

from armlab import State, contact, kinematics, models, plots, robots, sim
from armlab.log import Table

FORCE, GAIN, STIFFNESS, HEIGHT = 8.0, 0.002, 5000.0, 0.01  # N; m/s per newton; N/m; m, initial tool height


def main() -> None:
    robot = robots.load("yumi_right")
    arm = sim.SimulatedArm(robot, sim.synthetic_truth(robot), seed=3)
    estimator = contact.Estimator(models.load("model.toml"), robot)
    T_base_tool = kinematics.forward(robot, robot.q_home)
    x, y, surface = T_base_tool[:3, 3] - [0.04, 0.0, HEIGHT]
    q, angle, rows = robot.q_home, 0.0, []
    for k in range(3000):
        seen, depth = arm.measure(), surface - arm.sample.T_base_tool[2, 3]
        found = estimator.step(State(k * arm.period, arm.period, seen.q, seen.qd, seen.tau))
        wrench = np.array([0.0, 0.0, STIFFNESS * max(depth, 0.0), 0.0, 0.0, 0.0])
        rows.append((found.wrench, found.cov, wrench))
        if angle > 0 or found.wrench[2] > FORCE / 2:  # contact with the table: draw, 5 s per circle
            angle += arm.period * 2 * np.pi / 5 * min(1.0, 3 * angle + 0.1)
        T_base_tool[:2, 3] = [x + 0.04 * np.cos(angle), y + 0.04 * np.sin(angle)]
        T_base_tool[2, 3] -= arm.period * np.clip(GAIN * (FORCE - found.wrench[2]), -0.02, 0.02)
        before, q = q, kinematics.inverse(robot, T_base_tool, q, starts=1).q
        arm.step(q, (q - before) / arm.period, wrench)
    estimate, cov, true = map(np.array, zip(*rows))
    table = Table(arm.period * np.arange(3000), {"wrench_hat": estimate, "wrench_hat_cov": cov, "wrench_true": true})
    f, off = true[1000:, 2], (estimate - true)[1000:, 2]  # after 4 s
    print(f"force {f.mean():.1f} N, sd {f.std():.2f} N (target {FORCE} N); error {np.sqrt(np.mean(off**2)):.2f} N RMS")
    plots.wrench(table).savefig("constant_force.png", dpi=120)


if __name__ == "__main__":
    main()
