"""Errors of kinematic calibration relative to the Cramér-Rao bound, by Monte Carlo simulation with known truth.

Experiments of `sim.cell`: an IRB 2400 with errors in every frame (or in every parameter of its DH table). The error is
evaluated at validation poses that are not part of the fit, relative to the noise-free truth. Its bound ``J_v (J^T S^-1
J)^+ J_v^T`` is evaluated at the truth. NEES is e^T C^-1 e / rank, with C the covariance reported by the fit for some of
these poses (at least twice as many rows as the rank).

    python benchmarks/kinematics_bars.py 1000        seeds 2000, 2200, 2300, 2400
    python benchmarks/kinematics_bars.py 1000 70     the same, offset by 70
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from itertools import repeat
from typing import Any

import numpy as np
from all_cores import on_all_cores

from armlab.calibrate import fit_dual_arm, fit_kinematics
from armlab.estimation import Fit
from armlab.kinematics import forward, parameter_jacobian
from armlab.lie import so3
from armlab.models import DualArmCorrection, KinematicCorrection
from armlab.robots import from_local_poe
from armlab.sim import cell

HEAD = "| case | bound | error / bound | rank | NEES | outliers missed | good flagged |"
CASES = 12
SEEDS = {"K1": 2000, "K4": 2200, "K5": 2300, "K6": 2400}


@dataclass(frozen=True, eq=False)
class Bar:
    """One case: bounds and ratios of its blocks, rank, NEES, missed outliers, share of good samples flagged."""

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
        row = f"| {self.name} | {', '.join(self.bound)} | {ratios} | {self.rank} | {self.nees:.3f} "
        return row + f"| {self.missed} | {100 * self.false:.2f} % |"


@dataclass(frozen=True, eq=False)
class Sample:
    """One run: squared errors and variances by block, rank, NEES, flags, and the number of outliers, which come
    first."""

    squares: np.ndarray
    bounds: np.ndarray
    rank: int
    nees: float
    flags: np.ndarray
    bad: int


def bars(runs: int, shift: int = 0) -> list[Bar]:
    """Return all cases; `shift` is added to the seeds."""
    return on_all_cores(_case, range(CASES), repeat(runs), repeat(shift))


def _case(number: int, runs: int, shift: int) -> Bar:
    one, wave, far, two = (cell(seed + shift) for seed in SEEDS.values())
    pose, point = ("mm", "deg"), ("mm",)
    cases: list[tuple[str, Callable[[int], Sample], tuple[str, ...]]] = [
        ("K1 pose, every frame", lambda k: arm_sample(one.kinematics(k, tool=False)), pose),
        ("K1 pose, every number of the table", lambda k: arm_sample(one.kinematics(k, truth="dh", tool=False)), pose),
        ("K2 position, tool", lambda k: arm_sample(one.kinematics(k), position=True), point),
        ("K3 K1 with model=poe", lambda k: arm_sample(one.kinematics(k, tool=False), model="poe"), pose),
        ("K4 harmonics 1 and 2, pose", lambda k: arm_sample(wave.kinematics(k, 100, harmonics=True), waves=True),
         (*pose, "deg of amplitude")),
        ("K4 harmonics 1 and 2, position",
         lambda k: arm_sample(wave.kinematics(k, 100, harmonics=True), position=True, waves=True), point),
        ("K5 distance to an unknown point", lambda k: distance_sample(far.distances(k)), point),
        ("K6 two arms, relative pose", lambda k: dual_sample(two.two_arms(k)), pose),
        ("K6 two arms, relative position", lambda k: dual_sample(two.two_arms(k), position=True), point),
        ("K7 2 of 50 wrong", lambda k: arm_sample(one.kinematics(k, wrong=2), bad=2), pose),
        ("K7 5 of 50 wrong", lambda k: arm_sample(one.kinematics(k, wrong=5), bad=5), pose),
        ("K7 two arms, 6 of 60 wrong", lambda k: dual_sample(two.two_arms(k, wrong=6), bad=6), pose),
    ]  # fmt: skip
    name, make, units = cases[number]
    return _bar(name, [make(k) for k in range(runs)], units)


def _bar(name: str, samples: list[Sample], units: tuple[str, ...]) -> Bar:
    bound = np.sqrt(np.mean([s.bounds for s in samples], axis=0))[: len(units)]
    rms = np.sqrt(np.mean([s.squares for s in samples], axis=0))[: len(units)]
    sizes = [1e3 if unit == "mm" else 180.0 / np.pi for unit in units]
    missed = sum(int(np.sum(~s.flags[: s.bad])) for s in samples)
    false = sum(int(np.sum(s.flags[s.bad :])) for s in samples) / sum(len(s.flags) - s.bad for s in samples)
    text = tuple(f"{b * size:.4g} {unit}" for b, size, unit in zip(bound, sizes, units))
    (rank,) = {s.rank for s in samples}
    return Bar(name, text, rms / bound, rank, float(np.mean([s.nees for s in samples])), missed, false)


def truth_value(truth: Any) -> KinematicCorrection:
    """Return the true arm as a correction, whose Jacobians give the bound."""
    orders = tuple(range(1, truth.amplitudes.shape[1] // 2 + 1))
    robot = from_local_poe("truth", truth.frames, truth.screws)
    cov = np.eye(6 * len(truth.frames) + truth.amplitudes.size)
    return KinematicCorrection(robot, robot.name, robot.hash, orders, truth.amplitudes, np.zeros(0), cov)


def measured(run: Any, position: bool) -> dict[str, Any]:
    """Return poses or their positions, with the noise."""
    if position:
        return {"position": run.pose[:, :3, 3], "noise": run.noise[0]}
    return {"pose": run.pose, "noise": run.noise}


def arm_sample(run: Any, position: bool = False, waves: bool = False, bad: int = 0, model: str = "local_poe") -> Sample:
    """Fit poses or positions of one arm."""
    data = (
        {"position": run.pose[:, :3, 3], "noise": run.noise[0]} if position else {"pose": run.pose, "noise": run.noise}
    )
    fit = fit_kinematics(run.robot, run.q, harmonics=(1, 2) if waves else (), robust=bad > 0, model=model, **data)
    truth, rows = truth_value(run.truth), slice(3 if position else 6)
    J = _white(truth.pose_jacobian(run.q[bad:]), run.noise)[:, rows]
    P = information(J.reshape(-1, J.shape[-1]), fit.excitation.rank)
    e = pose_errors(fit.value.forward(run.q_valid), run.pose_valid)
    squares, bounds = _blocks(e**2), _blocks(_variances(truth.pose_jacobian(run.q_valid), P))
    if waves:
        squares.append(float(np.mean((fit.value.amplitudes - run.truth.amplitudes) ** 2)))
        bounds.append(float(np.mean(np.diag(P)[-truth.amplitudes.size :])))
    value = fit.value
    return _sample(squares, bounds, fit, e[:, rows], lambda few: value.pose_jacobian(run.q_valid[few])[:, rows],
                   value.cov, bad)  # fmt: skip


def distance_sample(run: Any) -> Sample:
    """Fit distances to an unknown point."""
    fit = fit_kinematics(run.robot, run.q, distance=run.distance, anchor=run.guess, noise=run.noise_distance)
    truth = truth_value(run.truth).robot
    J, _ = _distances(truth, run.anchor, run.q)
    P = information(J / run.noise_distance, fit.excitation.rank)
    J, length = _distances(truth, run.anchor, run.q_valid)
    variances = np.sum((J @ P) * J, axis=1)
    J, found = _distances(fit.value.robot, fit.value.anchor, run.q_valid)
    e = found - length
    return _sample(
        [float(np.mean(e**2))], [float(np.mean(variances))], fit, e[:, None], lambda few: J[few, None], fit.cov
    )


def _distances(robot: Any, anchor: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivatives of distances (N,) to a point with respect to frames and point, and the distances."""
    away = forward(robot, q)[:, :3, 3] - anchor
    length = np.linalg.norm(away, axis=1)
    along = away / length[:, None]
    J = np.einsum("na,nab->nb", along, parameter_jacobian(robot, q)[:, :3].reshape(len(q), 3, -1))
    return np.hstack([J, -along]), length


def dual_sample(run: Any, position: bool = False, bad: int = 0) -> Sample:
    """Fit poses or positions of one arm's tool relative to the other's."""
    data = (
        {"position": run.pose[:, :3, 3], "noise": run.noise[0]} if position else {"pose": run.pose, "noise": run.noise}
    )
    fit = fit_dual_arm(run.robot_a, run.robot_b, run.q_a, run.q_b, robust=bad > 0, **data)
    truth, rows = dual_truth(run), slice(3 if position else 6)
    J = _white(truth.pose_jacobian(run.q_a[bad:], run.q_b[bad:]), run.noise)[:, rows]
    P = information(J.reshape(-1, J.shape[-1]), fit.excitation.rank)
    e = pose_errors(fit.value.forward(run.q_valid_a, run.q_valid_b), run.relative(run.q_valid_a, run.q_valid_b))
    bounds = _blocks(_variances(truth.pose_jacobian(run.q_valid_a, run.q_valid_b), P))
    value = fit.value
    return _sample(_blocks(e**2), bounds, fit, e[:, rows],
                   lambda few: value.pose_jacobian(run.q_valid_a[few], run.q_valid_b[few])[:, rows],
                   value.cov, bad)  # fmt: skip


def dual_truth(run: Any) -> DualArmCorrection:
    """Return the true pair of arms as a correction."""
    arms = [truth_value(truth) for truth in (run.truth_a, run.truth_b)]
    return DualArmCorrection(arms[0], arms[1], run.T_basea_baseb, np.eye(90))


def _sample(
    squares: list[float],
    bounds: list[float],
    fit: Fit,
    e: np.ndarray,
    jacobian: Callable[[slice], np.ndarray],
    cov: np.ndarray,
    bad: int = 0,
) -> Sample:
    rank = fit.excitation.rank
    few = slice(-(-2 * rank // e.shape[1]))
    J = jacobian(few).reshape(-1, len(cov))
    nees = _nees(e[few].ravel(), J @ cov @ J.T, rank)
    return Sample(np.array(squares), np.array(bounds), rank, nees, fit.outliers, bad)


def information(J: np.ndarray, rank: int) -> np.ndarray:
    """Return the pseudoinverse of J^T J for a given rank."""
    _, s, V = np.linalg.svd(np.linalg.qr(J, mode="r"))
    root = V[:rank].T / s[:rank]
    return root @ root.T


def pose_errors(T: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return errors (N, 6), [v; w], v in base axes, w in tool axes."""
    turn = so3.log(np.swapaxes(truth[:, :3, :3], 1, 2) @ T[:, :3, :3])
    return np.concatenate([(T - truth)[:, :3, 3], turn], axis=1)


def _white(J: np.ndarray, noise: tuple[float, float]) -> np.ndarray:
    return J / np.repeat(noise, 3)[:, None]


def _variances(J: np.ndarray, P: np.ndarray) -> np.ndarray:
    return np.sum((J @ P) * J, axis=2)


def _blocks(squares: np.ndarray) -> list[float]:
    """Return the mean squares of position and rotation errors (N, 6)."""
    return [float(np.mean(np.sum(squares[:, part], axis=1))) for part in (slice(3), slice(3, 6))]


def _nees(e: np.ndarray, C: np.ndarray, rank: int) -> float:
    sd = np.sqrt(np.diag(C))
    values, vectors = np.linalg.eigh(C / np.outer(sd, sd))
    return float(np.sum((vectors[:, -rank:].T @ (e / sd)) ** 2 / values[-rank:])) / rank


if __name__ == "__main__":
    print(HEAD, "|---|---|---|---|---|---|---|", sep="\n")
    arguments = [int(text) for text in sys.argv[1:3]]
    for bar in bars(*(arguments or [100])):
        print(bar.text(), flush=True)
