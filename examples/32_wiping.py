"""Wipe a table: learn a periodic motion from a noisy demonstration, repeat it, then make it wider and faster."""

import numpy as np

from armlab import Command, State, bridge, kinematics, motion, plots, robots

ROBOT = robots.load("yumi_left")
START = kinematics.forward(ROBOT, ROBOT.q_home)
PERIOD, CHANGE, TURN = 1.6, 3.2, 2 * np.pi / 1.6  # s, s, rad/s


def demonstration() -> tuple[np.ndarray, np.ndarray]:
    """Return four periods of a hand-guided horizontal figure of eight, with 0.5 mm of noise."""
    t = np.arange(0.0, 4 * PERIOD, 0.004)
    eight = np.stack([0.02 * np.sin(2 * TURN * t), 0.05 * np.cos(TURN * t), np.zeros_like(t)], axis=1)
    return t, START[:3, 3] + eight + np.random.default_rng(0).normal(size=eight.shape) * 5e-4


def main() -> None:
    dmp = motion.fit_periodic_dmp(*demonstration(), period=PERIOD).value
    wiping = dmp.stepper(r=0.0, y0=START[:3, 3], v0=np.zeros(3))

    def wipe(state: State) -> Command:
        r, period = (min(state.t, 1.0), PERIOD) if state.t < CHANGE else (1.5, 0.75 * PERIOD)  # smooth start from rest
        wiping.change(r=r, period=period)
        T_base_tool = START.copy()
        T_base_tool[:3, 3] = wiping.step(state.dt)[0]
        return Command(kinematics.inverse(ROBOT, T_base_tool, state.q, starts=1).q)

    with bridge.connect("sim://yumi_left?lockstep=true", ROBOT) as link:
        table = link.run(wipe, seconds=6.0).table
    T_base_tool = kinematics.forward(ROBOT, table["q"])
    for name, rows in (("first", slice(400, 800)), ("wider and faster", slice(1100, 1500))):
        x, y, z = 1e3 * np.ptp(T_base_tool[rows, :3, 3], axis=0)
        print(f"{name}: {x:.0f} mm by {y:.0f} mm, height range {z:.1f} mm")
    plots.poses(T_base_tool, table.t, rotation=False).figure.savefig("wiping.png")


if __name__ == "__main__":
    main()
