"""Statistical contract of `fit_kinematics` and `fit_dual_arm`: ten properties with their measured values.

Errors are evaluated at validation poses, with at least twice as many rows as the rank. The fit gives their covariance,
and the truth gives their bound. The narrow limits apply from 1000 runs on.

    python benchmarks/kinematics_contract.py 2000
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import kinematics_bars as bars
import numpy as np

from armlab.calibrate import fit_dual_arm, fit_kinematics
from armlab.estimation import Contract, Experiment, Fit, Gauge, check_estimator
from armlab.lie import se3, so3
from armlab.sim import cell

FRAME = se3.from_rp(so3.exp([0.4, -1.0, 2.0]), [1.0, 2.0, -3.0])
JOINT = 3  # joint at rest in the case where a fit must raise an error
FEW = 20


@dataclass(frozen=True)
class Truth:
    """Joint positions of validation poses (of both arms if there are two), and the true poses."""

    q: tuple[np.ndarray, ...]
    T: np.ndarray


def main(runs: int) -> None:
    """Print the contracts."""
    for name, check in (("fit_kinematics, poses", _poses), ("fit_kinematics, positions", _positions),
                        ("fit_dual_arm, poses", _dual)):  # fmt: skip
        print(f"{name}\n\n```\n{check(runs).text()}\n```\n", flush=True)


def _poses(runs: int) -> Contract:
    return _check(fit_kinematics, _arm(False), slice(6), 50, runs, "joint 4 did not move")


def _positions(runs: int) -> Contract:
    return _check(fit_kinematics, _arm(True), slice(3), 50, runs, "joint 4 did not move")


def _dual(runs: int) -> Contract:
    made = cell(bars.SEEDS["K6"])
    q = made.two_arms().q_valid_a[:FEW], made.two_arms().q_valid_b[:FEW]

    def drawn(seed: int, n: int) -> tuple[dict[str, Any], Truth, Any]:
        run = made.two_arms(seed, n)
        return {**run.given, "noise": run.noise}, Truth(q, run.relative(*q)), run

    return _check(fit_dual_arm, drawn, slice(6), 60, runs, "joint 4 of arm a did not move")


def _arm(position: bool) -> Callable[[int, int], tuple[dict[str, Any], Truth, Any]]:
    made = cell(bars.SEEDS["K1"])
    q = made.kinematics().q_valid[:FEW]

    def drawn(seed: int, n: int) -> tuple[dict[str, Any], Truth, Any]:
        run = made.kinematics(seed, n)
        data = {"robot": run.robot, "q": run.q, **bars.measured(run, position)}
        return data, Truth((q,), run.truth.forward(q)), run

    return drawn


def _check(
    fit: Callable[..., Fit[Any]], drawn: Callable[..., Any], rows: slice, n: int, runs: int, named: str
) -> Contract:
    kind = "position" if rows.stop == 3 else "pose"

    def experiment(seed: int, n: int) -> Experiment:
        data, truth, run = drawn(seed, n)
        value = bars.dual_truth(run) if fit is fit_dual_arm else bars.truth_value(run.truth)
        q = (run.q_a, run.q_b) if fit is fit_dual_arm else (run.q,)
        J = (value.pose_jacobian(*q) / np.repeat(run.noise, 3)[:, None])[:, rows].reshape(-1, len(value.cov))
        rank = {("pose", 1): 30, ("position", 1): 27, ("pose", 2): 54}[kind, len(q)]
        J_valid = value.pose_jacobian(*truth.q)[:, rows].reshape(-1, len(value.cov))
        return Experiment(data, truth, J_valid @ bars.information(J, rank) @ J_valid.T)

    def error(found: Fit[Any], truth: Truth) -> tuple[np.ndarray, np.ndarray]:
        e = bars.pose_errors(found.value.forward(*truth.q), truth.T)[:, rows]
        J = found.value.pose_jacobian(*truth.q)[:, rows].reshape(-1, len(found.value.cov))
        return e.ravel(), J @ found.value.cov @ J.T

    def spoil(data: dict[str, Any], rng: np.random.Generator) -> tuple[dict[str, Any], np.ndarray]:
        wrong = n // 20
        bad, measured = np.arange(n) < wrong, np.array(data[kind])
        for one in measured[:wrong]:
            u, v = (w / np.linalg.norm(w) for w in rng.standard_normal((2, 3)))
            if kind == "pose":
                one[:3, :3] = one[:3, :3] @ so3.exp(np.radians(2.0) * u)
            place = one[:3, 3] if kind == "pose" else one
            place += 0.02 * v
        return {**data, kind: measured, "robust": True}, bad

    still, truth, run = drawn(0, n)
    q = "q" if "q" in still else "q_a"
    stiff = {**still, q: np.where(np.arange(6) == JOINT, 0.3, still[q])}
    stiff[kind] = _seen(fit, run, stiff, kind)
    gauge = Gauge(
        "frame of the measurement",
        lambda data: {**data, kind: _moved(data[kind], kind)},
        lambda found: Truth(truth.q, se3.project(FRAME @ found.value.forward(*truth.q))[0]),
    )
    if fit is fit_dual_arm:
        gauge = Gauge("base of both arms", _turned, lambda found: Truth(truth.q, found.value.forward(*truth.q)))
    blocks = {"position": np.flatnonzero(np.arange(FEW * rows.stop) % rows.stop < 3)}
    if rows.stop == 6:
        blocks["rotation"] = np.flatnonzero(np.arange(FEW * 6) % 6 >= 3)
    return check_estimator(
        fit, experiment, runs, n=n, error=error, blocks=blocks, gauges=[gauge], refusals={named: stiff}, spoil=spoil
    )


def _seen(fit: Callable[..., Any], run: Any, data: dict[str, Any], kind: str) -> np.ndarray:
    """Return noisy measurements of an arm with one joint at rest."""
    T = run.relative(data["q_a"], data["q_b"]) if fit is fit_dual_arm else run.truth.forward(data["q"])
    rng = np.random.default_rng(0)
    turns = so3.exp(run.noise[1] * rng.standard_normal((len(T), 3)))
    T = se3.from_rp(T[:, :3, :3] @ turns, T[:, :3, 3] + run.noise[0] * rng.standard_normal((len(T), 3)))
    return T[:, :3, 3] if kind == "position" else T


def _moved(seen: np.ndarray, kind: str) -> np.ndarray:
    return seen @ FRAME[:3, :3].T + FRAME[:3, 3] if kind == "position" else se3.project(FRAME @ seen)[0]


def _turned(data: dict[str, Any]) -> dict[str, Any]:
    """Return the same data with both nominal arms on different bases, which does not affect the measurements."""
    feet = [se3.project(FRAME @ data[name].T_base_mount)[0] for name in ("robot_a", "robot_b")]
    return {
        **data,
        "robot_a": replace(data["robot_a"], T_base_mount=feet[0]),
        "robot_b": replace(data["robot_b"], T_base_mount=feet[1]),
    }


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 200)
