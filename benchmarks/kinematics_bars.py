"""Errors of kinematic calibration over the Cramér-Rao bound, by Monte Carlo with known truth.

An IRB 2400 with every frame (or every number of its table) wrong; generators of `armlab.sim`. The error is that of
validation poses that the fit has not seen, against the noise-free truth; its bound ``J_v (J^T S^-1 J)^+ J_v^T`` is
taken at the truth. NEES: e^T C^-1 e over the rank, C the covariance that the fit states for twenty of these poses.

    python benchmarks/kinematics_bars.py 1000
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from armlab.calibrate import fit_dual_arm, fit_kinematics
from armlab.calibrate._arm import Arm
from armlab.calibrate._dual_problem import DualProblem, DualState
from armlab.calibrate._kinematic_data import measured_kinds
from armlab.estimation import Fit
from armlab.kinematics import frame_jacobian
from armlab.lie import so3
from armlab.models import KinematicCorrection
from armlab.sim._cell_kinematics import (
    ANCHOR,
    NOISE,
    DualRun,
    KinematicRun,
    as_robot,
    distance_run,
    dual_run,
    kinematic_run,
    outlier_run,
)

HEAD = "| case | bound | error / bound | rank | NEES | outliers missed | good flagged |"
FEW = 20  # validation poses whose covariance is judged
DISTANCE = 5e-5


@dataclass(frozen=True, eq=False)
class Bar:
    """One case: bounds and ratios of its blocks, rank, NEES, outliers missed, share of the good that was flagged."""

    name: str
    bound: tuple[str, ...]
    ratios: np.ndarray
    rank: int
    nees: float
    missed: int
    false: float

    def text(self) -> str:
        """Return one row of a table."""
        ratios = " ".join(f"{x:.3f}" for x in self.ratios)
        nees = f"{self.nees:.3f}" if np.isfinite(self.nees) else "-"
        row = f"| {self.name} | {', '.join(self.bound)} | {ratios} | {self.rank} | {nees} "
        return row + f"| {self.missed} | {100 * self.false:.2f} % |"


@dataclass(frozen=True, eq=False)
class Sample:
    """One run: squared errors and variances by block, the fit, its NEES, which samples were wrong."""

    squares: np.ndarray
    bounds: np.ndarray
    fit: Fit
    nees: float
    bad: int


def bars(runs: int) -> Iterator[Bar]:
    """Yield all cases."""
    cases: list[tuple[str, Callable[[int], Sample], tuple[str, ...]]] = [
        ("K1 pose, every frame", lambda k: _arm(kinematic_run(k)), ("mm", "deg")),
        ("K1 pose, every number of the table", lambda k: _arm(kinematic_run(k, truth="dh")), ("mm", "deg")),
        ("K2 position, tool", lambda k: _arm(kinematic_run(k, tool=True), position=True), ("mm",)),
        ("K4 harmonics 1 and 2, pose", lambda k: _arm(waves(k), orders=(1, 2)), ("mm", "deg", "deg of amplitude")),
        ("K4 harmonics 1 and 2, position", lambda k: _arm(waves(k), position=True, orders=(1, 2)), ("mm",)),
        ("K5 distance to an unknown point", _distance, ("mm",)),
        ("K6 two arms, relative pose", lambda k: _dual(dual_run(k), False), ("mm", "deg")),
        ("K6 two arms, relative position", lambda k: _dual(dual_run(k), True), ("mm",)),
        ("K7 2 of 50 wrong", lambda k: _arm(outlier_run(k, 2), bad=2), ("mm", "deg")),
        ("K7 5 of 50 wrong", lambda k: _arm(outlier_run(k, 5), bad=5), ("mm", "deg")),
    ]
    for name, make, units in cases:
        yield _bar(name, [make(k) for k in range(runs)], units)


def _bar(name: str, samples: list[Sample], units: tuple[str, ...]) -> Bar:
    bound = np.sqrt(np.mean([s.bounds for s in samples], axis=0))[: len(units)]
    rms = np.sqrt(np.mean([s.squares for s in samples], axis=0))[: len(units)]
    sizes = [1e3 if unit == "mm" else 180.0 / np.pi for unit in units]
    flags = [s.fit.outliers for s in samples]
    missed = sum(int(np.sum(~flag[: s.bad])) for flag, s in zip(flags, samples))
    good = sum(len(flag) - s.bad for flag, s in zip(flags, samples))
    false = sum(int(np.sum(flag[s.bad :])) for flag, s in zip(flags, samples)) / good
    text = tuple(f"{b * size:.4g} {unit}" for b, size, unit in zip(bound, sizes, units))
    nees = float(np.mean([s.nees for s in samples]))
    return Bar(name, text, rms / bound, samples[0].fit.excitation.rank, nees, missed, false)


def waves(run: int) -> KinematicRun:
    """Return experiment K4."""
    return kinematic_run(run, 2200, 100, tool=True, harmonics=True)


def truth_value(run: KinematicRun) -> KinematicCorrection:
    """Return the truth as a correction, whose Jacobians make the bound."""
    arm, m = run.truth, run.truth.amplitudes.shape[1]
    orders = tuple(range(1, m // 2 + 1))
    robot = as_robot(replace(arm, amplitudes=np.zeros((6, 0))))
    d = 42 + arm.amplitudes.size
    return KinematicCorrection(robot, robot.name, robot.hash, orders, arm.amplitudes, np.zeros(0), np.eye(d))


def information(J: np.ndarray, rank: int) -> np.ndarray:
    """Return the pseudoinverse of J^T J at a rank."""
    _, s, V = np.linalg.svd(np.linalg.qr(J, mode="r"))
    root = V[:rank].T / s[:rank]
    return root @ root.T


def _arm(run: KinematicRun, position: bool = False, orders: tuple[int, ...] = (), bad: int = 0) -> Sample:
    data = {"position": run.pose[:, :3, 3], "noise": NOISE[0]} if position else {"pose": run.pose, "noise": NOISE}
    fit = fit_kinematics(run.robot, run.q, harmonics=orders, robust=bad > 0, **data)
    truth, weight = truth_value(run), 1.0 / np.repeat(NOISE, 3)
    rows = slice(3) if position else slice(6)
    J = (truth.pose_jacobian(run.q[bad:]) * weight[:, None])[:, rows]
    P = information(J.reshape(-1, J.shape[-1]), fit.excitation.rank)
    J_valid = truth.pose_jacobian(run.q_valid)
    C = np.sum((J_valid @ P) * J_valid, axis=2)
    e = _errors(fit.value.forward(run.q_valid), run.pose_valid)
    squares, bounds = _blocks(e**2), _blocks(C)
    if orders:
        squares.append(float(np.mean((fit.value.amplitudes - run.truth.amplitudes) ** 2)))
        bounds.append(float(np.mean(np.diag(P)[42:])))
    J = fit.value.pose_jacobian(run.q_valid[:FEW])[:, rows].reshape(-1, len(fit.value.cov))
    nees = _nees(e[:FEW, rows].ravel(), J @ fit.value.cov @ J.T, fit.excitation.rank)
    return Sample(np.array(squares), np.array(bounds), fit, nees, bad)


def _distance(k: int) -> Sample:
    run, anchor, distance = distance_run(k)
    fit = fit_kinematics(run.robot, run.q, distance=distance, anchor=ANCHOR, noise=DISTANCE)
    robot = truth_value(run).robot

    def rows(q: np.ndarray, tool: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        away = tool[:, :3, 3] - anchor
        length = np.linalg.norm(away, axis=1)
        along = away / length[:, None]
        J = np.einsum("na,nab->nb", along, frame_jacobian(robot, q)[:, :3].reshape(len(q), 3, -1))
        return np.hstack([J, -along]), length

    J, _ = rows(run.q, run.truth.forward(run.q))
    J_valid, length = rows(run.q_valid, run.pose_valid)
    C = np.sum((J_valid @ information(J / DISTANCE, fit.excitation.rank)) * J_valid, axis=1)
    found = np.linalg.norm(fit.value.forward(run.q_valid)[:, :3, 3] - fit.value.anchor, axis=1)
    return Sample(np.array([np.mean((found - length) ** 2)]), np.array([np.mean(C)]), fit, np.nan, 0)


def _dual(run: DualRun, position: bool) -> Sample:
    data = {"position": run.pose[:, :3, 3], "noise": NOISE[0]} if position else {"pose": run.pose, "noise": NOISE}
    fit = fit_dual_arm(run.robot_a, run.robot_b, run.q_a, run.q_b, **data)
    rank = fit.excitation.rank
    J = _dual_jacobian(run, run.q_a, run.q_b)
    white = (J / np.repeat(NOISE, 3)[:, None])[:, slice(3) if position else slice(6)]
    J_valid = _dual_jacobian(run, run.q_valid_a, run.q_valid_b)
    C = np.sum((J_valid @ information(white.reshape(-1, J.shape[-1]), rank)) * J_valid, axis=2)
    e = _errors(fit.value.forward(run.q_valid_a, run.q_valid_b), run.relative(run.q_valid_a, run.q_valid_b))
    return Sample(np.array(_blocks(e**2)), np.array(_blocks(C)), fit, np.nan, 0)


def _dual_jacobian(run: DualRun, q_a: np.ndarray, q_b: np.ndarray) -> np.ndarray:
    """Return how the relative pose depends on all unknowns, at the truth."""
    arms = [
        Arm.of(as_robot(truth), q, (), np.zeros((*q.shape, 0)), "local_poe")
        for truth, q in ((run.truth_a, q_a), (run.truth_b, q_b))
    ]
    kinds, _ = measured_kinds(len(q_a), {"pose": run.relative(q_a, q_b)}, None, None)
    problem = DualProblem(arms[0], arms[1], tuple(kinds), False, False, np.zeros(0, dtype=bool), None)
    return problem.measurements(DualState(arms[0].first(), arms[1].first(), run.T_basea_baseb))[0].J


def _errors(T: np.ndarray, truth: np.ndarray) -> np.ndarray:
    turn = so3.log(np.swapaxes(truth[:, :3, :3], 1, 2) @ T[:, :3, :3])
    return np.concatenate([(T - truth)[:, :3, 3], turn], axis=1)


def _blocks(squares: np.ndarray) -> list[float]:
    """Return mean squares of position and rotation from (N, 6)."""
    return [float(np.mean(np.sum(squares[:, part], axis=1))) for part in (slice(3), slice(3, 6))]


def _nees(e: np.ndarray, C: np.ndarray, rank: int) -> float:
    sd = np.sqrt(np.diag(C))
    values, vectors = np.linalg.eigh(C / np.outer(sd, sd))
    return float(np.sum((vectors[:, -rank:].T @ (e / sd)) ** 2 / values[-rank:])) / rank


if __name__ == "__main__":
    print(HEAD, "|---|---|---|---|---|---|---|", sep="\n")
    for bar in bars(int(sys.argv[1]) if len(sys.argv) > 1 else 100):
        print(bar.text(), flush=True)
