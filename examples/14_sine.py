"""Sway one joint along a sine: the whole controller is a function, and the log says how far the arm lags behind.

`armlab run yumi_left examples/14_sine.py:sine --seconds 6` runs the same function; with --link egm://0.0.0.0:6510 and
--speed 0.1 on a real arm.
"""

import numpy as np

from armlab import Command, State, bridge, log, robots

JOINT, AMPLITUDE, FREQUENCY = 3, np.deg2rad(15), 0.5  # counted from 0; rad; Hz


def sine(state: State) -> Command:
    """Begin at rest where the arm stands: 1 - cos has no speed at first."""
    w = 2 * np.pi * FREQUENCY
    q, qd = state.q_start.copy(), np.zeros(len(state.q))
    q[JOINT] += AMPLITUDE * (1 - np.cos(w * state.t)) / 2
    qd[JOINT] = AMPLITUDE * w * np.sin(w * state.t) / 2
    return Command(q, qd)


def main() -> None:
    with bridge.connect("sim://yumi_left?lockstep=true", robots.load("yumi_left")) as link:
        run = link.run(sine, seconds=6.0, record="one_joint.mcap")
    table = log.read(run.path).between(1.0, 6.0)
    asked, done = (np.rad2deg(table[name][:, JOINT]) for name in ("q_sent", "q"))
    lag = min(range(50), key=lambda k: np.ptp(asked[: len(asked) - k] - done[k:]))
    print(f"asked for {np.ptp(asked):.2f} deg, moved {np.ptp(done):.2f} deg, {4 * lag} ms behind")


if __name__ == "__main__":
    main()
