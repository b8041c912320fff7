"""Errors of hand-eye calibration relative to the Cramér-Rao bound, by Monte Carlo simulation with known truth.

Experiments of `sim.cell`: H1 uniform rotations, H2 tilts of at most 30 degrees, H3 outliers in the first poses, H4
additional robot noise, H5 three LEDs. Error ratios are the RMS error over runs divided by the RMS bound. NEES is e^T
C^-1 e / dimension with the covariance reported by the fit.

    python benchmarks/hand_eye_bars.py 1000          seeds of the specification
    python benchmarks/hand_eye_bars.py 1000 50000    other seeds, offset by 50000
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import repeat
from typing import Any

import numpy as np
from all_cores import on_all_cores

from armlab.calibrate import fit_hand_eye, fit_hand_eye_points
from armlab.calibrate.hand_eye import HandEyeEquation, Pair
from armlab.calibrate.hand_eye_points import PointModel, Points, marked_start
from armlab.estimation import Measurement
from armlab.lie import so3
from armlab.sim import cell
from armlab.sim.experiments.sensors import CAMERA, MARKER, Poses

ROBOTS = ((0.2e-3, np.radians(0.03)), (0.5e-3, np.radians(0.05)))
TILT = np.radians(30.0)


def poses(
    seed: int, run: int, N: int = 30, tilt: bool = False, bad: int = 0, robot: tuple[float, float] | None = None
) -> tuple[Poses, Poses]:
    """Return the data of H1 to H4, and the same data without noise or outliers."""
    data = cell(seed).hand_eye(run, N, tilt=TILT if tilt else None, robot=robot, wrong=bad)
    return data, replace(data, A=data.A_exact, B=data.B_exact)


def pose_error(T: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return the error [v; w] of T = (R Exp(w), t + v), with R and t the truth."""
    return np.concatenate([T[:3, 3] - truth[:3, 3], so3.log(truth[:3, :3].T @ T[:3, :3])])


@dataclass(frozen=True)
class Bar:
    """Result of one case.

    Attributes
    ----------
    name : name of the case. crb : bounds of X rotation [deg] and position [mm], and of Y. ratios : errors over bounds.
    nees : NEES over its dimension. missed : unflagged gross outliers. false : share of good samples flagged.
    """

    name: str
    crb: np.ndarray
    ratios: np.ndarray
    nees: float
    missed: int
    false: float

    def text(self) -> str:
        """Return one row of a table."""
        crb = " ".join("–" if np.isnan(x) else f"{x:.4f}" for x in self.crb)
        ratios = " ".join("–" if np.isnan(x) else f"{x:.3f}" for x in self.ratios)
        return f"| {self.name} | {crb} | {ratios} | {self.nees:.3f} | {self.missed} | {100 * self.false:.2f} % |"


class Tally:
    """Collects runs of one case."""

    def __init__(self, name: str) -> None:
        self.name, self.e, self.variance, self.nees = name, [], [], []
        self.missed = self.false = self.good = 0

    def add(self, fit: Any, e: np.ndarray, bound: np.ndarray, bad: np.ndarray) -> None:
        """Add one run: error and bound of X and Y (12,), or of points and Y, and the mask (N,) of wrong samples."""
        missing = np.full(6, np.nan) if len(e) != 12 else e[:6]
        self.e.append(np.concatenate([missing, e[-6:]]))
        self.variance.append(np.diag(bound)[-12:])
        self.nees.append(e @ np.linalg.solve(fit.cov, e) / len(e))
        self.missed += int(np.sum(bad & ~fit.outliers))
        self.false += int(np.sum(~bad & fit.outliers))
        self.good += int(np.sum(~bad))

    def bar(self) -> Bar:
        """Return the result over all runs."""
        e, variance = np.array(self.e) ** 2, np.array(self.variance)
        order = [slice(3, 6), slice(0, 3), slice(9, 12), slice(6, 9)]
        bound = np.sqrt([(variance + 0.0 * e)[:, part].sum(axis=1).mean() for part in order])
        rms = np.sqrt([e[:, part].sum(axis=1).mean() for part in order])
        crb = bound * np.array([np.degrees(1.0), 1e3, np.degrees(1.0), 1e3])
        return Bar(self.name, crb, rms / bound, float(np.mean(self.nees)), self.missed, self.false / self.good)


def pose_case(name: str, seed: int, runs: int, given: bool = True, **how: Any) -> Bar:
    """Return the result of H1 to H4: noise given or estimated, robust if there are outliers."""
    tally, bad, robot = Tally(name), how.get("bad", 0), how.get("robot")
    for run in range(runs):
        data, clean = poses(seed, run, **how)
        told = {"noise": CAMERA, "noise_robot": robot} if given else {}
        fit = fit_hand_eye(data.A, data.B, robust=bool(bad), **told)
        good = slice(bad, None)
        A, B = clean.A[good], clean.B[good]
        of_robot = None if robot is None else np.repeat(robot, 3) ** 2
        equation = HandEyeEquation(
            A[:, :3, :3], A[:, :3, 3], B[:, :3, :3], B[:, :3, 3], np.repeat(CAMERA, 3) ** 2, of_robot
        )
        (truth,) = equation.evaluate(Pair(data.X[:3, :3], data.X[:3, 3], data.Y[:3, :3], data.Y[:3, 3]))
        bound = np.linalg.inv(information(truth))
        e = np.concatenate([pose_error(fit.value.X, data.X), pose_error(fit.value.Y, data.Y)])
        tally.add(fit, e, bound, np.arange(len(data.A)) < bad)
    return tally.bar()


def information(one: Measurement) -> np.ndarray:
    """Return J^T S^-1 J of measurements at the truth."""
    cov = np.diag(one.cov) if one.cov.ndim == 1 else one.cov
    return np.sum(np.swapaxes(one.J, 1, 2) @ np.linalg.solve(cov, one.J), axis=0)


def led_case(
    name: str,
    seed: int,
    runs: int,
    sigma: float = 0.5e-3,
    missing: bool = False,
    known: bool = True,
    robot: tuple[float, float] | None = None,
) -> Bar:
    """Return the result of H5: three LEDs, 100 samples; NaN for X if the marker is unknown."""
    tally = Tally(name)
    for run in range(runs):
        data = cell(seed).marker_points(run, sigma=sigma, missing=0.2 if missing else 0.0, robot=robot)
        A, X, Y, seen, clean = data.A_exact, data.X, data.Y, data.visible, data.p_exact
        fit = fit_hand_eye_points(
            data.A, data.p, marker=MARKER if known else None, visible=seen, noise=sigma, noise_robot=robot
        )
        of_robot = None if robot is None else np.repeat(robot, 3) ** 2
        variance = np.full(3, sigma**2)
        sight = PointModel(A[:, :3, :3], A[:, :3, 3], clean[seen], *np.nonzero(seen), 3, variance, of_robot)
        points = MARKER @ X[:3, :3].T + X[:3, 3]
        at = Points(points, Y[:3, :3], Y[:3, 3])
        truth = sight.marked(MARKER).evaluate(marked_start(at, MARKER)) if known else sight.free().evaluate(at)
        first = pose_error(fit.value.X, X) if known else (fit.value.points - points).ravel()
        e = np.concatenate([first, pose_error(fit.value.Y, Y)])
        tally.add(fit, e, np.linalg.inv(sum(information(one) for one in truth)), np.zeros(100, dtype=bool))
    return tally.bar()


def bars(runs: int, shift: int = 0) -> list[Bar]:
    """Return the results of all cases of the specification.

    Parameters
    ----------
    runs : number of runs per case. shift : offset added to the seeds of the specification.
    """
    return on_all_cores(_case, range(len(CASES)), repeat(runs), repeat(shift))


def _case(number: int, runs: int, shift: int) -> Bar:
    case, name, seed, how = CASES[number]
    return case(name, seed + shift, runs, **how)


CASES: tuple[tuple[Callable[..., Bar], str, int, dict[str, Any]], ...] = (
    (pose_case, "H1 uniform", 1000, {}),
    (pose_case, "H2 tilt 30 degrees", 1000, {"tilt": True}),
    (pose_case, "H1, noise estimated", 1000, {"given": False}),
    (pose_case, "H2, noise estimated", 1000, {"given": False, "tilt": True}),
    *((pose_case, f"H3 {share} % outliers", 1000, {"bad": bad}) for bad, share in ((2, 5), (3, 10), (6, 20), (9, 30))),
    (pose_case, "H3 30 %, noise estimated", 1000, {"given": False, "bad": 9}),
    (pose_case, "H4 smaller robot noise", 1100, {"robot": ROBOTS[0]}),
    (pose_case, "H4 smaller, tilt", 1100, {"robot": ROBOTS[0], "tilt": True}),
    (pose_case, "H4 larger robot noise", 1100, {"robot": ROBOTS[1]}),
    (pose_case, "H4 larger, tilt", 1100, {"robot": ROBOTS[1], "tilt": True}),
    (led_case, "H5 LEDs", 1500, {}),
    (led_case, "H5, 20 % missing", 1500, {"missing": True}),
    (led_case, "H5, 50 mm of noise", 1500, {"sigma": 0.05}),
    (led_case, "H5, 50 mm, 20 % missing", 1500, {"sigma": 0.05, "missing": True}),
    (led_case, "H5, 20 % missing, larger robot noise", 1500, {"missing": True, "robot": ROBOTS[1]}),
    (led_case, "H5, unknown marker", 1500, {"known": False}),
    (led_case, "H5, unknown marker, 50 mm", 1500, {"sigma": 0.05, "known": False}),
)


HEAD = (
    "| case | bound [deg mm deg mm] | error / bound: X rotation, position, Y rotation, position | NEES/d | missed | "
    "false |"
)

if __name__ == "__main__":
    print(HEAD)
    for bar in bars(*(int(word) for word in sys.argv[1:3] or ["1000"])):
        print(bar.text(), flush=True)
