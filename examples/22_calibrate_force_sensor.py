"""Force sensor calibration with a 1 kg load in a hundred orientations: estimate axes, load and bias; flag contacts."""

import numpy as np

from armlab import calibrate, models, plots, sim
from armlab.lie import so3


def main() -> None:
    weighed = sim.cell(seed=1).force(torque=0.005, contacts=5)  # orientations and raw readings, with ground truth
    fit = calibrate.fit_force_sensor(weighed.RA, weighed.y, gravity=[0.0, 0.0, -9.82], robust=True)
    print(fit.report())
    fit.save("force_sensor.toml")
    sensor = models.load("force_sensor.toml")
    turned = 1e3 * so3.angle(sensor.R_tool_sensor, weighed.R)
    print(f"\ncontacts: {np.flatnonzero(fit.outliers)}; axis error {turned:.2f} mrad, mass {sensor.mass:.4f} kg")
    plots.calibration(fit).savefig("force_sensor.png", dpi=120)


if __name__ == "__main__":
    main()
