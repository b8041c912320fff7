"""Stop when the arm is touched: the contact estimator in the loop, no force sensor.

Runs after 03_identify.py, which leaves model.toml.
"""

from pathlib import Path

import numpy as np

from armlab import Command, State, bridge, contact, identify, models, robots

TOUCH = "t,fx,fy,fz,mx,my,mz\n3,0,0,0,0,0,0\n3.2,0,12,0,0,0,0\n9,0,12,0,0,0,0\n"  # a hand, from 3 s on
LIMIT = 6.0  # N, above what the estimate is off without contact


def main() -> None:
    robot = robots.load("yumi_right")
    estimator = contact.Estimator(models.load("model.toml"), robot)
    sway = identify.dither(robot.q_home, seconds=8.0).controller(approach=0.5)
    felt: list[str] = []

    def careful(state: State) -> Command:
        force = estimator.step(state).wrench[:3]
        if state.t > 1.0 and np.linalg.norm(force) > LIMIT:
            felt.append(f"touched after {state.t:.2f} s, force {force.round(1)} N")
            return Command.stop()  # comes to rest within the limits, then the run ends
        return sway(state)

    Path("touch.csv").write_text(TOUCH)
    with bridge.connect("sim://yumi_right?lockstep=true&seed=2&operator=touch.csv", robot) as link:
        run = link.run(careful, seconds=8.5)
    print(*felt, f"ended: {run.reason}", sep="\n")


if __name__ == "__main__":
    main()
