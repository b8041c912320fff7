"""Torque-based impedance control: the arm acts as a spring and damper about its start position, and a hand pushes it.

The simulated robot accepts torques through the research extension; standard EGM does not transmit torques. The arm
stops a few millimetres from its start, because such a soft spring cannot overcome friction.
"""

from pathlib import Path

import numpy as np

from armlab import Command, State, bridge, kinematics, plots, robots

PUSH = "t,fx,fy,fz,mx,my,mz\n1,0,0,0,0,0,0\n1.2,0,15,0,0,0,0\n3,0,15,0,0,0,0\n3.2,0,0,0,0,0,0\n"
STIFFNESS = np.array([80.0, 80, 60, 60, 20, 20, 10])  # N m/rad
DAMPING = np.array([8.0, 8, 6, 6, 1, 1, 0.3])  # N m s/rad
TAU_MAX = np.array([30.0, 30, 20, 20, 6, 6, 4])  # N m


def spring(state: State) -> Command:
    """Pull the arm back to its start; the drive compensates gravity."""
    return Command(tau=STIFFNESS * (state.q_start - state.q) - DAMPING * state.qd)


def main() -> None:
    robot = robots.load("yumi_right")
    limits = bridge.Limits.of(robot, tau_max=TAU_MAX)
    Path("push.csv").write_text(PUSH)
    with bridge.connect("sim://yumi_right?lockstep=true&seed=1&operator=push.csv", robot) as link:
        table = link.run(spring, seconds=5.0, limits=limits).table
    T_base_tool = kinematics.forward(robot, table["q"])
    T_base_tool[:, :3, 3] -= T_base_tool[0, :3, 3].copy()  # displacement from the start
    for when, t in (("before the push", 0.9), ("during", 2.9), ("after", 4.9)):
        way = 1e3 * T_base_tool[np.searchsorted(table.t - table.t[0], t), :3, 3]
        print(f"{when:15} tool displacement {way.round(1)} mm")
    plots.poses(T_base_tool, table.t - table.t[0], rotation=False).figure.savefig("impedance.png", dpi=120)


if __name__ == "__main__":
    main()
