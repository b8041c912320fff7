"""Identify a payload from motor torques and add it to the model, so its weight does not appear as a contact force."""

import numpy as np

from armlab import contact, identify, plots, robots, sim


def main() -> None:
    robot = robots.load("yumi_right")
    truth = sim.synthetic_truth(robot)  # simulated; on a robot: log.read("empty.mcap"), log.read("loaded.mcap")
    motion = identify.design_excitation(robot, seconds=15.0)
    empty = sim.record(sim.SimulatedArm(robot, truth, seed=1), motion)
    half_a_kilogram = sim.Mismatch(payload=0.5)
    loaded = sim.record(sim.SimulatedArm(robot, truth, seed=2, mismatch=half_a_kilogram), motion)

    model = identify.fit_dynamics(empty, robot)
    fit = identify.fit_payload(loaded, model, robot, without=empty)
    print(fit.report())
    fit.save("load.toml")

    carrying = fit.value.added_to(model.value)
    found = {
        name: contact.Estimator(used, robot).run(loaded)
        for name, used in (("load not in the model", model.value), ("load weighed", carrying))
    }
    for name, table in found.items():
        print(f"{name}: false force {np.sqrt(np.mean(table['wrench_hat'][:, :3] ** 2, axis=0)).round(2)} N RMS")
    plots.wrenches(found).savefig("load.png", dpi=120)


if __name__ == "__main__":
    main()
