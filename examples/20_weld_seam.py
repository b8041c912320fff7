"""Measure a plate and a weld seam with a tracker probe; compute the seam frame in the robot base, with covariance."""

import numpy as np

from armlab import frames, plots
from armlab.lie import se3, so3


def main() -> None:
    rng = np.random.default_rng(4)
    T_base_tracker = se3.from_rp(so3.exp([1.2, -1.1, 1.3]), [3.6, 0.0, 1.4])  # result of a calibration
    cov = np.diag([1e-4, 1e-4, 1e-4, 5e-5, 5e-5, 5e-5]) ** 2  # m, rad
    T_tracker_plate = se3.inv(T_base_tracker) @ se3.from_rp(so3.exp([0.0, 0.0, -0.5]), [1.1, -0.6, 0.6])  # true pose

    def touched(x: np.ndarray, y: np.ndarray, tip: float) -> np.ndarray:  # with 0.05 mm of tracker noise
        p = np.column_stack([x, y, np.full(len(x), tip)]) @ T_tracker_plate[:3, :3].T + T_tracker_plate[:3, 3]
        return p + 5e-5 * rng.standard_normal(p.shape)

    plate = touched(rng.uniform(-0.05, 0.25, 12), rng.uniform(-0.05, 0.2, 12), 0.0)
    seam = touched(np.linspace(0.0, 0.2, 6), np.linspace(0.02, 0.1, 6), 0.005)  # the probe tip has a radius of 5 mm
    seam[4] += 0.03 * T_tracker_plate[:3, 2]  # the probe slipped
    plane = frames.fit_plane(plate, robust=True, toward=[0.0, 0.0, 0.0])  # normal towards the tracker
    tip = frames.check_offset(plane.value, seam)
    line = frames.fit_line(seam[~tip.outliers])
    print(plane.report(), tip.text(), line.report(), sep="\n\n")
    shadow = frames.project(line.value, plane.value)  # the seam line, corrected for the tip radius
    start = frames.project(seam[0], plane.value)
    built = frames.build(z=shadow, y=-plane.value, origin=start, origin_cov=line.sigma[0] ** 2 * np.eye(3))
    graph = frames.Graph()  # frames, connected by poses with covariance
    graph.add("base", "tracker", T_base_tracker, cov, "calibration")
    graph.add("tracker", "seam", built.T, built.cov, "probe")
    T_base_seam, sd = graph.get("base", "seam"), 1e3 * graph.solve().sd[-6:]
    print(f"\nseam in base {T_base_seam[:3, 3]} m +- {sd[:3].round(2)} mm, rotation +- {sd[3:].round(2)} mrad")
    moved = [p @ T_base_tracker[:3, :3].T + T_base_tracker[:3, 3] for p in (plate, seam)]
    ax = plots.scene({"seam": T_base_seam}, *moved, *(item.moved(T_base_tracker) for item in (plane.value, shadow)))
    ax.figure.savefig("weld_seam.png", dpi=120)


if __name__ == "__main__":
    main()
