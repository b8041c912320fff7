"""Hand-eye calibration: estimate the poses of a camera and of a marker on the tool from samples with outliers."""

import numpy as np

from armlab import calibrate, models, plots, sim
from armlab.lie import so3


def main() -> None:
    seen = sim.cell(seed=1).hand_eye(N=30, wrong=2)  # robot poses and marker poses, with ground truth
    fit = calibrate.fit_hand_eye(seen.A, seen.B, robust=True)
    print(fit.report())
    fit.save("camera.toml")
    camera = models.load("camera.toml")
    away = 1e3 * np.linalg.norm(camera.T_base_cam[:3, 3] - seen.Y[:3, 3])
    turned = 1e3 * so3.angle(camera.T_base_cam[:3, :3], seen.Y[:3, :3])
    print(f"\noutliers: {np.flatnonzero(fit.outliers)}; camera error {away:.2f} mm and {turned:.2f} mrad")
    plots.calibration(fit).savefig("camera.png", dpi=120)


if __name__ == "__main__":
    main()
