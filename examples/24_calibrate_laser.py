"""Line scanner calibration: estimate the sensor pose on the tool from scans of three plates, with no initial guess."""

import numpy as np

from armlab import calibrate, models, plots, sim


def main() -> None:
    drawn = sim.cell(seed=1).laser(wrong=3)  # tool poses and lines on the plates, with ground truth
    fit = calibrate.fit_laser_plane(drawn.A, drawn.scans, drawn.plane, robust=True)
    print(fit.report())
    fit.save("laser.toml")
    off = models.load("laser.toml").T_tool_sensor[:3, 3] - drawn.X[:3, 3]
    print(f"\noutlier scans: {np.flatnonzero(fit.outliers)}; scanner position error {1e3 * np.linalg.norm(off):.2f} mm")
    plots.calibration(fit).savefig("laser.png", dpi=120)


if __name__ == "__main__":
    main()
