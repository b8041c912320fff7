"""Reproduce figures of TFRT-7651, section 5, on the simulated YuMi: torque covariance, tip contacts, 500 g payload."""

import numpy as np

from armlab import contact, identify, log, plots, robots, sim

WEIGHT = [(20.0, 0, 4.905), (23.0, 2, -4.905)]  # s, axis, N: weight of 500 g on both tools, along x, then -z
FIRST = {"left": 10.0, "right": 1.0}  # start of the 5 N presses along base x, y, z [s]


def measure(side: str) -> tuple[log.Table, log.Table]:
    """Identify one arm, then press on its tip while the arm sways; return the estimates for both logs."""
    robot = robots.load(f"yumi_{side}")
    presses = [(FIRST[side] + 3.0 * axis, axis, 5.0) for axis in range(3)] + WEIGHT

    def hand(t: np.ndarray) -> np.ndarray:
        corners = np.array([0.0, 0.1, 2.0, 2.1])
        return sum(np.outer(np.interp(t, s + corners, [0, f, f, 0]), np.eye(6)[axis]) for s, axis, f in presses)

    arm = sim.SimulatedArm(robot, sim.synthetic_truth(robot), seed=1)
    excited = sim.record(arm, identify.design_excitation(robot, 24.0))
    estimator = contact.Estimator(identify.fit_dynamics(excited, robot).value, robot)
    return estimator.run(excited), estimator.run(sim.record(arm, identify.dither(robot.q_home, 27.0), hand))


def main() -> None:
    arms = {side: measure(side) for side in FIRST}
    free = arms["right"][0].between(0.5, np.inf)
    e, qd = -free["tau_error"], free["qd"]  # exp: equation 3 of the report; step: equation 4
    curves = {kind: identify.fit_velocity_covariance(e, qd, kind).value for kind in ("exp", "step")}
    plots.residual_speed(free, curves, joints=[1]).savefig("report_1.png", dpi=120)
    for number, start, end in ((2, 0.5, 19.5), (3, 19.5, 26.0)):
        shown = {f"{side} arm": pressed.between(start, end) for side, (_, pressed) in arms.items()}
        plots.wrenches(shown).savefig(f"report_{number}.png", dpi=120)
        for name, table in shown.items():
            print(f"report_{number}.png, {name}:", contact.compare(table).text())


if __name__ == "__main__":
    main()
