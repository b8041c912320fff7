"""Laser line scanners on plates: error over the Cramér-Rao bound, success without a guess, outliers, coverage, time.

Cases L1 to L4 of the specification, drawn by `sim.cell`: three plates, 20 scans each, 0.5 mm. Scans are drawn in
batches, which preserves the specified distribution but not the samples. Scans nearly parallel to a plate, which the fit
rejects, are redrawn.
"""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
from all_cores import on_all_cores
from blocks import Contender, Table, loop, table

from armlab.calibrate import fit_laser_plane
from armlab.calibrate.laser_model import tangents
from armlab.errors import ArmlabError
from armlab.estimation import Contract, Experiment, Fit, check_estimator
from armlab.lie import se3, so3
from armlab.sim import cell
from armlab.sim.experiments.sensors import ANGLE, SIGMA, scanned, turns

BAR, WRONG = 1.05, 3
SEEDS = (4000, 4700)
CONTRACT, ORIGIN = "the contract", "L4, plates through the origin"  # the contract runs first, because it takes longest
LAWS = ("order-free", "gauge-free", "refuses", "saves", "explains", "clean")


def run(quick: bool) -> list[Table]:
    """Evaluate every case in many runs with two seeds, and the contract for one case; then time single fits."""
    runs, contract = (50, 100) if quick else (300, 1000)
    lines = [
        f"Error of T_tool_sensor / bound, target {BAR} (1.06 with outliers); standard error with both seeds "
        f"{1.0 / np.sqrt(6.0 * len(SEEDS) * runs):.3f}; NEES / dimension."
    ]
    jobs = [(SEEDS[0], CONTRACT, contract), *((seed, name, runs) for seed, name in product(SEEDS, [*CASES, ORIGIN]))]
    lines += on_all_cores(_line, *zip(*jobs, strict=True))
    data, wrong, mixed = ([_draw(SEEDS[0], i, wrong=bad)[0] for i in range(10)] for bad in (False, True, False))
    for one in mixed:
        one["plane"] = np.random.default_rng(0).permutation(one["plane"])
    unknown = [{**one, "noise": None} for one in data]
    contenders = [
        Contender("armlab, no guess", loop(lambda one: fit_laser_plane(**one), data), "armlab"),
        Contender("armlab, no guess, noise estimated", loop(lambda one: fit_laser_plane(**one), unknown), "armlab"),
        Contender("armlab, robust", loop(lambda one: fit_laser_plane(**one), wrong), "armlab"),
        Contender("armlab, refusal of wrong labels", loop(_refused, mixed), "armlab"),
    ]
    return [table("Laser scanners on plates", "\n\n".join(lines), "ms", contenders, 2 if quick else 3)]


def _refused(data: dict[str, Any]) -> None:
    try:
        fit_laser_plane(**data)
    except ArmlabError:
        return
    raise AssertionError("wrong labels were not rejected")


def _draw(
    seed: int, run: int, lines: bool = True, wrong: bool = False, moved: bool = False
) -> tuple[dict[str, Any], Any, Any]:
    """Return the arguments, the same arguments with noise-free scans, and the sensor pose."""
    bad = WRONG if wrong else 0
    drawn = cell(seed).laser(run, wrong=bad)
    A, scans = drawn.A.copy(), drawn.scans.copy()
    if not lines:
        scans[:, 2:] = drawn.exact[:, 2:]
    if moved:
        A[:, :3, 3] -= 1.0
    noise = (SIGMA, ANGLE if lines else 1e-5)
    data = {"T_base_tool": A, "scans": scans, "plane": drawn.plane, "noise": noise, "robust": wrong}
    exact = {"T_base_tool": A[bad:], "scans": drawn.exact[bad:], "plane": drawn.plane[bad:], "noise": noise}
    return data, exact, drawn.X


CASES: dict[str, dict[str, bool]] = {
    "L1, no guess": {},
    "L1, noise estimated": {"estimated": True},
    "L1, guess": {"guess": True},
    "L2, exact lines": {"lines": False},
    "L3, three wrong scans": {"wrong": True},
}


def _line(seed: int, name: str, runs: int) -> str:
    if name == ORIGIN:
        return f"Seed {seed}, {name}: {origin(seed, runs)}."
    if name != CONTRACT:
        return f"Seed {seed}, {name}: {judged(name, seed, runs)}."
    contract = contracted(seed, runs)
    found = "; ".join(contract[part].text for part in ("consistent", "honest", "efficient", "robust"))
    return f"Seed {seed}, {name}, {runs} runs: {'passed' if contract.passed else 'FAILED'}; {found}."


def judged(name: str, seed: int, runs: int) -> str:
    """Describe the result of a case in one line."""
    return _ratios(seed, runs, **CASES[name])


def _ratios(
    seed: int, runs: int, guess: bool = False, lines: bool = True, wrong: bool = False, estimated: bool = False
) -> str:
    e2, bound, nees, lengths = np.zeros(2), np.zeros(2), [], []
    failed = missed = false = 0
    for run in range(runs):
        data, exact, X = _draw(seed, run, lines, wrong)
        if guess:
            rng = np.random.default_rng([seed, run, 1])
            angles = np.radians(60.0) * (rng.random(3) - 0.5)
            data["start"] = se3.from_rp(turns(angles), 0.4 * (rng.random(3) - 0.5)) @ X
        if estimated:
            data["noise"] = None
        try:
            fit = fit_laser_plane(**data)
        except ArmlabError:
            failed += 1
            continue
        e = _pose_error(fit.value.T_tool_sensor, X)
        C = fit_laser_plane(**exact).cov[:6, :6]
        nees.append(e @ np.linalg.solve(fit.cov[:6, :6], e) / 6)
        e2 += [e[3:] @ e[3:], e[:3] @ e[:3]]
        bound += [np.trace(C[3:, 3:]), np.trace(C[:3, :3])]
        lengths.append(np.linalg.norm(e[:3]))
        if wrong:
            missed += int(np.sum(~fit.outliers[:WRONG]))
            false += int(fit.outliers[WRONG:].sum())
    rotation, position = np.sqrt(e2 / bound)
    flags = f"; {missed} wrong scans missed, {100.0 * false / (runs * 60):.2f} % false" if wrong else ""
    size = np.sqrt(bound / len(nees))
    return (
        f"{runs - failed} of {runs} runs; rotation {rotation:.3f} of {np.degrees(size[0]):.4f} deg, position "
        f"{position:.3f} of {1e3 * size[1]:.4f} mm (median error {1e3 * np.median(lengths):.3f} mm); NEES "
        f"{np.mean(nees):.3f}{flags}"
    )


def origin(seed: int, runs: int) -> str:
    """Report how far the result moves if the plates pass through the origin."""
    worst = 0.0
    for run in range(runs):
        one, other = (fit_laser_plane(**_draw(seed, run, moved=m)[0]).value.T_tool_sensor for m in (False, True))
        worst = max(worst, float(np.abs(one - other).max()))
    return f"X moves by at most {worst:.1e} in {runs} runs"


def contracted(seed: int, runs: int) -> Contract:
    """Return the statistical part of the contract."""

    def experiment(k: int, n: int) -> Experiment:
        drawn, noise = scanned([seed, k], n), (SIGMA, ANGLE)
        bound = fit_laser_plane(drawn.A, drawn.exact, drawn.plane, noise=noise, start=drawn.X).cov
        return Experiment({**drawn.given, "noise": noise}, (drawn.X, drawn.n, drawn.d), bound)

    return check_estimator(
        fit_laser_plane, experiment, runs, n=60, error=_error, spoil=_spoil,
        blocks={"position": range(3), "rotation": range(3, 6)},
        skip=dict.fromkeys(LAWS, "invariant, tested in tests/calibrate"),
    )  # fmt: skip


def _error(fit: Fit[Any], truth: tuple[np.ndarray, np.ndarray, np.ndarray]) -> np.ndarray:
    (X, n, d), value = truth, fit.value
    tilts = -np.einsum("jab,ja->jb", tangents(value.normals), n)
    planes = np.column_stack([tilts, value.offsets - d]).ravel()
    return np.concatenate([_pose_error(value.T_tool_sensor, X), planes])


def _pose_error(found: np.ndarray, X: np.ndarray) -> np.ndarray:
    return np.concatenate([found[:3, 3] - X[:3, 3], so3.log(X[:3, :3].T @ found[:3, :3])])


def _spoil(data: dict[str, Any], rng: np.random.Generator) -> tuple[dict[str, Any], np.ndarray]:
    """Move 5 % of the scans by 20 mm and rotate them by 10 degrees."""
    bad = np.zeros(len(data["plane"]), dtype=bool)
    bad[rng.choice(len(bad), len(bad) // 20, replace=False)] = True
    scans = data["scans"].copy()
    scans[bad, 1] += 0.02
    scans[bad, 2:] = scans[bad, 2:] @ so3.exp([0.0, 0.0, np.radians(-10.0)])[:2, :2]
    return {**data, "scans": scans, "robust": True}, bad
