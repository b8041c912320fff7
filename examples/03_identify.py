"""Excite a simulated YuMi, identify gravity, inertia and friction from the log, and save the model."""

import numpy as np

from armlab import bridge, identify, log, robots


def main() -> None:
    robot = robots.load("yumi_right")
    motion = identify.design_excitation(robot, seconds=30.0, seed=0)
    with bridge.connect("sim://yumi_right?lockstep=true&seed=1", robot) as link:
        run = link.run(motion.controller(approach=3.0), seconds=33.0, record="excite.mcap")
    fit = identify.fit_dynamics(log.read(run.path), robot)
    print(fit.report())
    print("saved", fit.save("model.toml"))

    model = fit.value
    pose = robot.q_home
    gravity = model.rigid_torque(pose, 0 * pose, 0 * pose)
    print("gravity torque at home [N m]:", np.round(gravity, 3))
    for name, value, sd in list(zip(fit.names, fit.parameters, fit.sd))[-7:]:
        print(f"{name:18s} {value:+.4f} +- {sd:.4f}")


if __name__ == "__main__":
    main()
