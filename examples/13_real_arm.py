"""Identify a Staubli TX40 from a public log of motor angles and currents, without velocities; the wrist is coupled."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from armlab import identify, log, robots
from armlab.robots import couplings

FOLDER = Path(sys.argv[1] if len(sys.argv) > 1 else "staubli_tx40")
GEARS = np.diag([32.0, 32.0, 45.0, -48.0, 45.0, 32.0])  # q_motor = GEARS @ q
GEARS[5, 4] = 32.0  # motor 6 also rotates with joint 5
ZERO = np.array([0, -np.pi / 2, np.pi / 2, 0, 0, 0])  # joint zeros of the URDF relative to the motors [rad]


def main() -> None:
    if not FOLDER.is_dir():
        print(f"Folder {FOLDER} not found. Download the URDF, pos_read_data.csv and curr_data.csv of the TX40 from")
        print("github.com/thanhndv212/figaroh-plus (Apache-2.0) and pass their folder as the first argument.")
        return
    robot = replace(robots.load(FOLDER / "tx40_mdh_modified.urdf"), coupling=np.linalg.inv(GEARS))
    angles, currents = (next(FOLDER.glob(f"{name}.csv*")) for name in ("pos_read_data", "curr_data"))
    angles, currents = (log.read_csv(path, rate=5000.0) for path in (angles, currents))
    q = couplings.motor_to_joint(robot, angles.matching("Joint")) + ZERO
    tau = couplings.motor_torque_to_joint(robot, currents.matching("Joint"))
    whole = log.Table(angles.t, {"q": q, "tau": tau})

    fit = identify.fit_dynamics(whole.between(0.1, 5.8), robot)
    print(fit.report())
    print(identify.extrapolation(fit.value, whole.between(5.8, 8.9)).text())

    later = identify.predict(fit.value, whole.between(5.8, 7.2))
    error = np.sqrt(np.mean((later["tau"] - later["tau_model"]) ** 2, axis=0)) / later["tau"].std(axis=0)
    print("residual on unseen motion [% of torque sd]:", (100 * error).round(1))


if __name__ == "__main__":
    main()
