"""Hand-eye calibration compared with OpenCV: times, and errors relative to the Cramér-Rao bound on the same samples.

OpenCV is pinned below 5: opencv-contrib-python-headless 5.0.0.93 exports the constants for hand-eye calibration but not
the functions.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import hand_eye_bars as bars
import numpy as np
from all_cores import on_all_cores
from blocks import Contender, Table, agree, loop, table

from armlab.calibrate import fit_hand_eye, fit_hand_eye_points
from armlab.lie import se3, so3
from armlab.sim.experiments.sensors import MARKER

BAR, BAR_MANY, BAR_ROBUST = {"HORAUD": 1.0}, {"LI": 1.0}, {"HORAUD": 2.0}  # armlab's time over OpenCV's
BOTH = {"SHAH": cv2.CALIB_ROBOT_WORLD_HAND_EYE_SHAH, "LI": cv2.CALIB_ROBOT_WORLD_HAND_EYE_LI}
HAND = {
    "HORAUD": cv2.CALIB_HAND_EYE_HORAUD,
    "PARK": cv2.CALIB_HAND_EYE_PARK,
    "DANIILIDIS": cv2.CALIB_HAND_EYE_DANIILIDIS,
    "TSAI": cv2.CALIB_HAND_EYE_TSAI,
}
Solve = Callable[[bars.Poses], tuple[np.ndarray, np.ndarray]]


def run(quick: bool) -> list[Table]:
    """Measure 30 and 1000 pairs of poses, outliers, and points; then run every case many times to determine the
    errors."""
    cv2.setNumThreads(1)  # single-threaded like armlab, without waiting for threads of other libraries
    rounds, runs = (5, 50) if quick else (20, 500)
    few = [bars.poses(1000, k)[0] for k in range(20)]
    many = [bars.poses(1000, 0, N=1000)[0]]
    wrong = [bars.poses(1000, k, bad=3)[0] for k in range(20)]
    worst = _agreement()
    text = f"The camera noise is given. On noise-free data, all agree to {worst:.1g}."
    return [
        table("Hand-eye, 30 pairs of poses", f"{text}\n\n{_errors(runs)}", "ms", _contenders(few, BAR, ""), rounds),
        table("Hand-eye, 1000 pairs of poses", text, "ms", _contenders(many, BAR_MANY, ""), 2, warm=False),
        table("Hand-eye, 10 % of 30 pairs wrong", "OpenCV has no outlier rejection; its errors are 18 to 346 times "
        "the bound.",
              "ms", _contenders(wrong, BAR_ROBUST, "robust"), rounds),
        table("Hand-eye from points of a marker", "100 samples of three LEDs; no peer supports them.", "ms",
              _points(), rounds),
    ]  # fmt: skip


def _contenders(data: list[bars.Poses], allowed: dict[str, float], robust: str) -> list[Contender]:
    def ours(sample: bars.Poses) -> object:
        return fit_hand_eye(sample.A, sample.B, noise=bars.CAMERA, robust=bool(robust))

    def estimated(sample: bars.Poses) -> object:
        return fit_hand_eye(sample.A, sample.B, robust=bool(robust))

    peers = [
        Contender(f"OpenCV {name}", loop(solve, data), bar=allowed.get(name), note=note)
        for name, solve, note in _peers()
    ]
    name = f"armlab fit_hand_eye{', robust' if robust else ''}"
    note = "value, covariance, residuals, excitation"
    return [
        Contender(name, loop(ours, data), "armlab", note=note),
        Contender(f"{name}, noise estimated", loop(estimated, data), "armlab"),
        *peers,
    ]


def _points() -> list[Contender]:
    data = []
    for k in range(10):
        sample, _ = bars.poses(1500, k, N=100)
        T = se3.inv(sample.Y) @ sample.A @ sample.X
        data.append((sample.A, np.einsum("nij,kj->nki", T[:, :3, :3], MARKER) + T[:, None, :3, 3]))

    def known(sample: tuple[np.ndarray, np.ndarray]) -> object:
        return fit_hand_eye_points(*sample, marker=MARKER, noise=5e-4)

    def free(sample: tuple[np.ndarray, np.ndarray]) -> object:
        return fit_hand_eye_points(*sample, noise=5e-4)

    return [
        Contender("armlab fit_hand_eye_points, known marker", loop(known, data), "armlab"),
        Contender("armlab fit_hand_eye_points, unknown marker", loop(free, data), "armlab"),
    ]


def _peers() -> list[tuple[str, Solve, str]]:
    both = [(name, _both(method), "X and Y, no covariance") for name, method in BOTH.items()]
    return both + [(name, _hand(method), "X; Y by the mean, no covariance") for name, method in HAND.items()]


def _both(method: int) -> Solve:
    """Solve A X = Z B, which is world2cam X = Z base2gripper in OpenCV's notation."""

    def solve(data: bars.Poses) -> tuple[np.ndarray, np.ndarray]:
        RX, tX, RY, tY = cv2.calibrateRobotWorldHandEye(
            list(data.A[:, :3, :3]), list(data.A[:, :3, 3]), list(data.B[:, :3, :3]), list(data.B[:, :3, 3]),
            method=method,
        )  # fmt: skip
        return _pose(RX, tX), _pose(RY, tY)

    return solve


def _hand(method: int) -> Solve:
    """Solve for X, OpenCV's cam2gripper. A_i X B_i^-1 is the same for all i; its mean over i is Y."""

    def solve(data: bars.Poses) -> tuple[np.ndarray, np.ndarray]:
        inverse = se3.inv(data.B)
        R, t = cv2.calibrateHandEye(
            list(data.A[:, :3, :3]), list(data.A[:, :3, 3]), list(inverse[:, :3, :3]), list(inverse[:, :3, 3]),
            method=method,
        )  # fmt: skip
        X = _pose(R, t)
        products = data.A @ X @ inverse
        RY = so3.project(products[:, :3, :3].mean(axis=0))[0]
        return X, se3.from_rp(RY, products[:, :3, 3].mean(axis=0))

    return solve


def _pose(R: np.ndarray, t: np.ndarray) -> np.ndarray:
    return se3.from_rp(so3.project(R)[0], np.ravel(t))


def _agreement() -> float:
    """Return the largest error of any method on noise-free data."""
    _, clean = bars.poses(1000, 0)
    worst = 0.0
    for name, solve, _ in _peers():
        for pose, truth in zip(solve(clean), (clean.X, clean.Y)):
            worst = max(worst, agree(name, pose, truth, 1e-6))
    return worst


def _errors(runs: int) -> str:
    """Return tables of errors relative to the bound: armlab in every case, OpenCV without outliers."""
    ours = [bars.HEAD, "|---|---|---|---|---|---|", *(bar.text() for bar in bars.bars(runs))]
    head = ["| OpenCV, error / bound | H1: X rotation, position, Y rotation, position | H2 (tilt 30 degrees) |",
            "|---|---|---|"]  # fmt: skip
    both = zip(*on_all_cores(_ratios, [runs, runs], [False, True]), strict=True)
    theirs = [
        f"| {name} | {uniform} | {tilted} |" for (name, _, _), (uniform, tilted) in zip(_peers(), both, strict=True)
    ]
    deviation = 1.0 / np.sqrt(6.0 * runs)
    what = f"Errors relative to the Cramér-Rao bound in {runs} runs; the standard error of a ratio is {deviation:.3f}."
    return "\n".join([what, "", *ours, "", *head, *theirs])


def _ratios(runs: int, tilt: bool) -> list[str]:
    """Return the errors of each peer relative to the bounds of H1 or H2."""
    bound = bars.pose_case("bound", 1000, min(runs, 200), tilt=tilt).crb
    errors: list[list[np.ndarray]] = [[] for _ in _peers()]
    for k in range(runs):
        data, _ = bars.poses(1000, k, tilt=tilt)
        for (_, solve, _), e in zip(_peers(), errors, strict=True):
            X, Y = solve(data)
            e.append(np.concatenate([bars.pose_error(X, data.X), bars.pose_error(Y, data.Y)]))
    squares = np.array(errors).reshape(len(errors), runs, 4, 3) ** 2
    rms = np.sqrt(squares.sum(axis=3).mean(axis=1))[:, [1, 0, 3, 2]]
    return [" ".join(f"{x:.2f}" for x in row) for row in rms * [np.degrees(1.0), 1e3, np.degrees(1.0), 1e3] / bound]
