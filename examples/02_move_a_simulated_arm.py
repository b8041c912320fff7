"""Move one joint of a simulated YuMi sinusoidally over EGM, record a log and read it back.

To move a real arm, read docs/egm.md, then set `url` to "egm://192.168.125.50:6510". This URL contains the address of
this computer on the robot's network.
"""

import numpy as np

from armlab import Command, State, bridge, log, robots


def sine(state: State) -> Command:
    """Oscillate the wrist by ±10 degrees at 0.5 Hz, starting at rest at the current position."""
    grow = min(state.t, 1.0)
    q, qd = state.q_start.copy(), np.zeros(len(state.q))
    q[-1] += grow * np.deg2rad(10) * np.sin(np.pi * state.t)
    qd[-1] = grow * np.deg2rad(10) * np.pi * np.cos(np.pi * state.t)
    return Command(q, qd)


def main() -> None:
    url = "sim://yumi_right?lockstep=true"  # as fast as possible; omit lockstep for real time
    with bridge.connect(url, robots.load("yumi_right")) as link:
        run = link.run(sine, seconds=6.0, record="sine.mcap")
    print(run.report())
    table = log.read(run.path)
    print(table)
    swing = np.rad2deg(np.ptp(table["q"], axis=0))
    print("range of each joint [deg]:", np.round(swing, 2))


if __name__ == "__main__":
    main()
