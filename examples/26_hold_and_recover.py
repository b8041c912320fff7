"""Teach a motion by hand and repeat it; hold the arm for two seconds and release it: the motion resumes.

Reproduces the experiment of Karlsson et al. (IFAC 2017) on a simulated YuMi over EGM. A sensor measures the hand force.
"""

import numpy as np

from armlab import State, bridge, kinematics, motion, plots, robots

INERTIA = 0.5  # kg m^2, apparent inertia of each joint
HELD = (1.0, 3.0)  # s
ROBOT = robots.load("yumi_right")


def give_way(state: State) -> np.ndarray:
    """Return the acceleration caused by the force of a hand."""
    return kinematics.jacobian(ROBOT, state.q).T @ state.wrench_raw / INERTIA


def main() -> None:
    with bridge.connect("sim://yumi_right?program=lead-through&seed=3", ROBOT) as link:
        taught = link.run(None, seconds=2.5).table  # in real time, as with a human hand
    dmp = motion.fit_dmp(taught.t, taught["q"], scaling="none").value
    two_dof = motion.TwoDofDmp(dmp, e0=0.02)  # rad, above the tracking lag
    controller = two_dof.controller(ROBOT, give_way=give_way)
    url = f"sim://yumi_right?lockstep=true&force=true&grip={HELD[0]},{HELD[1]}"
    with bridge.connect(url, ROBOT) as link:
        table = link.run(controller, seconds=6.0, extra=controller.columns()).table

    run = two_dof.recorded(table, [HELD])
    before, after = np.searchsorted(run.t, HELD)
    tool = kinematics.forward(ROBOT, run.ya)[:, :3, 3]
    moved = 1e3 * np.linalg.norm(tool[before:after] - tool[before], axis=1).max()
    print(f"held: tool moved {moved:.1f} mm, path slowed by a factor of {run.tau_a.max() / run.tau_a.min():.0f}")
    print(f"released: path error {1e3 * np.abs(run.ya[-1] - run.yc[-1]).max():.1f} mrad, done: {controller.done}")
    plots.two_dof(run, [3, 5]).savefig("recovery.png")


if __name__ == "__main__":
    main()
