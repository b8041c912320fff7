"""Estimate the force of a hand inside a controller while the arm sways; print the force once a second.

Run 03_identify.py first; it writes model.toml.
"""

from pathlib import Path

from armlab import Command, State, bridge, contact, identify, models, robots

PRESS = "t,fx,fy,fz,mx,my,mz\n3.0,0,0,0,0,0,0\n3.1,0,0,-5,0,0,0\n5.0,0,0,-5,0,0,0\n5.1,0,0,0,0,0,0\n"


def main() -> None:
    robot = robots.load("yumi_right")
    estimator = contact.Estimator(models.load("model.toml"), robot)
    sway = identify.dither(robot.q_home, seconds=8.0).controller(approach=0.5)
    said = 0

    def controller(state: State) -> Command:
        nonlocal said
        wrench = estimator.step(state)
        if state.t > said:  # once a second
            said += 1
            force, band = wrench.wrench[:3], 2 * wrench.sigma[:3]
            print(f"{state.t:4.1f} s  force {force.round(1)} N  +- {band.round(1)} N")
        return sway(state)

    Path("press.csv").write_text(PRESS)
    with bridge.connect("sim://yumi_right?lockstep=true&seed=2&operator=press.csv", robot) as link:
        link.run(controller, seconds=8.5)


if __name__ == "__main__":
    main()
