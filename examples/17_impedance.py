"""Impedance by torque: the arm is a spring with a damper around its start, and a hand pushes it.

Torques travel by the research extension, which the simulated robot speaks; standard EGM refuses them. The millimetres
that stay in the end are friction: a spring this soft cannot overcome it.
"""

from pathlib import Path

import numpy as np

from armlab import Command, State, bridge, kinematics, robots

PUSH = "t,fx,fy,fz,mx,my,mz\n1,0,0,0,0,0,0\n1.2,0,15,0,0,0,0\n3,0,15,0,0,0,0\n3.2,0,0,0,0,0,0\n"
STIFFNESS = np.array([80.0, 80, 60, 60, 20, 20, 10])  # N m/rad
DAMPING = np.array([8.0, 8, 6, 6, 1, 1, 0.3])  # N m s/rad
TAU_MAX = np.array([30.0, 30, 20, 20, 6, 6, 4])  # N m


def spring(state: State) -> Command:
    """Pull back to the start; the drive itself carries the weight of the arm."""
    return Command(tau=STIFFNESS * (state.q_start - state.q) - DAMPING * state.qd)


def main() -> None:
    robot = robots.load("yumi_right")
    limits = bridge.Limits.of(robot, tau_max=TAU_MAX)
    Path("push.csv").write_text(PUSH)
    with bridge.connect("sim://yumi_right?lockstep=true&seed=1&operator=push.csv", robot) as link:
        table = link.run(spring, seconds=5.0, limits=limits).table
    tool = kinematics.forward(robot, table["q"])[:, :3, 3]
    for when, t in (("before the push", 0.9), ("during", 2.9), ("after", 4.9)):
        y = 1e3 * (tool[np.searchsorted(table.t - table.t[0], t)] - tool[0])
        print(f"{when:15} the tool is {y.round(1)} mm from its start")


if __name__ == "__main__":
    main()
