"""Guide an arm by hand and repeat the motion: record without sending commands, then replay the log.

`armlab record yumi_right --lead-through -o taught.mcap` records from the command line.
"""

import numpy as np

from armlab import Command, State, bridge, kinematics, log, plots, robots

SECONDS, APPROACH = 3.0, 1.0  # s


def replay(table: log.Table):
    """Return a controller that moves to the first posture of a log and then follows the log."""
    t, q = table.t - table.t[0], table["q"]
    slow = np.array([np.convolve(np.pad(x, 12, "edge"), np.hanning(27)[1:-1] / 13, "valid") for x in q.T]).T

    def controller(state: State) -> Command:
        share = min(state.t / APPROACH, 1.0)
        share *= share * (3 - 2 * share)  # at rest at both ends
        there = [np.interp(state.t - APPROACH, t, joint) for joint in slow.T]
        return Command(state.q_start + share * (np.array(there) - state.q_start))

    return controller


def main() -> None:
    robot = robots.load("yumi_right")
    with bridge.connect("sim://yumi_right?program=lead-through&seed=3", robot) as link:
        taught = link.run(None, seconds=SECONDS, record="taught.mcap").table  # in real time, as with a human hand
    with bridge.connect("sim://yumi_right?lockstep=true", robot) as link:
        done = link.run(replay(taught), seconds=APPROACH + SECONDS, record="repeated.mcap").table
    for name, table in (("led by hand", taught), ("repeated", done)):
        print(f"{name}: ended at {np.rad2deg(table['q'][-1]).round(1)} deg after {len(table)} packets")
    paths = (kinematics.forward(robot, table["q"]) for table in (taught, done))
    plots.scene(*paths).figure.savefig("repeated.png", dpi=120)


if __name__ == "__main__":
    main()
