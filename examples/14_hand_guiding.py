"""Hand guiding without a force sensor: the arm yields to a hand force estimated from motor torques.

Run 03_identify.py first; it writes model.toml.
"""

from pathlib import Path

import numpy as np

from armlab import Command, State, bridge, contact, kinematics, models, plots, robots

PUSHES = """t,fx,fy,fz,mx,my,mz
1,0,0,0,0,0,0\n1.3,0,20,0,0,0,0\n2.5,0,20,0,0,0,0\n2.8,0,0,0,0,0,0
4,0,0,0,0,0,0\n4.3,0,0,20,0,0,0\n5.5,0,0,20,0,0,0\n5.8,0,0,0,0,0,0"""
YIELD = 0.005  # m/s per newton


def main() -> None:
    robot = robots.load("yumi_right")
    estimator = contact.Estimator(models.load("model.toml"), robot)

    def give_way(state: State) -> Command:
        found = estimator.step(state)
        force, band = found.wrench[:3], 2 * found.sigma[:3]
        certain = np.sign(force) * np.maximum(np.abs(force) - band, 0.0)  # the band includes friction at rest
        qd = np.linalg.pinv(robot.chain.jacobian(state.q)[:3]) @ (YIELD * certain)
        return Command(qd=qd, record={"wrench_hat": found.wrench, "wrench_hat_cov": found.cov})

    Path("pushes.csv").write_text(PUSHES)
    with bridge.connect("sim://yumi_right?lockstep=true&seed=2&operator=pushes.csv", robot) as link:
        table = link.run(give_way, seconds=7.0).table
    tool = 1e3 * kinematics.forward(robot, table["q"])[:, :3, 3]
    rows = np.searchsorted(table.t - table.t[0], [1.0, 3.5])
    for push, way in zip(("without a push", "pushed along y", "pushed along z"), np.diff(tool[[0, *rows, -1]], axis=0)):
        print(f"{push}: moved by {way.round() + 0.0} mm")
    plots.wrench(table).savefig("hand_guiding.png", dpi=120)


if __name__ == "__main__":
    main()
