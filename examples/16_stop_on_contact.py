"""Stop on contact: run the contact estimator in the control loop, without a force sensor.

Run 03_identify.py first; it writes model.toml.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from armlab import Command, State, bridge, contact, identify, models, plots, robots

TOUCH = "t,fx,fy,fz,mx,my,mz\n3,0,0,0,0,0,0\n3.2,0,12,0,0,0,0\n9,0,12,0,0,0,0\n"  # a hand presses after 3 s
LIMIT = 6.0  # N, above the estimation error without contact


def main() -> None:
    robot = robots.load("yumi_right")
    estimator = contact.Estimator(models.load("model.toml"), robot)
    sway = identify.dither(robot.q_home, seconds=8.0).controller(approach=0.5)
    felt: list[str] = []

    def careful(state: State) -> Command:
        found = estimator.step(state)
        if state.t > 1.0 and np.linalg.norm(found.wrench[:3]) > LIMIT:
            felt.append(f"touched after {state.t:.2f} s, force {found.wrench[:3].round(1)} N")
            return Command.stop()  # the arm comes to rest within its limits, then the run ends
        return replace(sway(state), record={"wrench_hat": found.wrench, "wrench_hat_cov": found.cov})

    Path("touch.csv").write_text(TOUCH)
    with bridge.connect("sim://yumi_right?lockstep=true&seed=2&operator=touch.csv", robot) as link:
        run = link.run(careful, seconds=8.5)
    print(*felt, f"ended: {run.reason}", sep="\n")
    plots.wrench(run.table).savefig("touched.png", dpi=120)


if __name__ == "__main__":
    main()
