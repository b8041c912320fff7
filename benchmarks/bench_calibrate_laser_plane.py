"""Laser line scanners on plates: error over the Cramér-Rao bound, how often without a guess, outliers, honesty, time.

Cases L1 to L4 of the specification, drawn by `sim.cell`: three plates, 20 scans each, 0.5 mm. Scans are tried many at
once, so that the experiments have the distribution of the specification, not its samples; scans whose plate is nearly
parallel to the laser plane, which the fit refuses, are drawn again.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from blocks import Contender, Table, loop, table

from armlab.calibrate import fit_laser_plane
from armlab.errors import ArmlabError
from armlab.lie import se3, so3
from armlab.sim import cell
from armlab.sim._cell_laser import ANGLE, SIGMA, turns

BAR, WRONG = 1.05, 3


def run(quick: bool) -> list[Table]:
    """Judge every case on many runs, then time fits of one experiment."""
    few, many = (20, 50) if quick else (200, 1000)
    lines = [f"Error of T_tool_sensor over the bound, bar {BAR}; NEES over its dimension."]
    lines.append(_judged("L1, no guess", many))
    lines.append(_judged("L1, guess", few, guess=True))
    lines.append(_judged("L2, exact lines", few, lines=False))
    lines.append(_judged("L3, three wrong scans", few, wrong=True))
    lines.append(_origin(few))
    data = [_draw(i)[0] for i in range(10)]
    wrong = [_draw(i, wrong=True)[0] for i in range(10)]
    contenders = [
        Contender("armlab, no guess", loop(lambda one: fit_laser_plane(**one), data), "armlab", 1e-2),
        Contender("armlab, robust", loop(lambda one: fit_laser_plane(**one), wrong), "armlab"),
    ]
    return [table("Laser scanners on plates", "\n\n".join(lines), "ms", contenders, 2 if quick else 10)]


def _draw(run: int, lines: bool = True, wrong: bool = False, origin: bool = False) -> tuple[dict[str, Any], Any, Any]:
    """Return arguments, those of exact scans, and the pose of the sensor."""
    bad = WRONG if wrong else 0
    drawn = cell(4000).laser(run, wrong=bad)
    A, scans = drawn.A.copy(), drawn.scans.copy()
    if not lines:
        scans[:, 2:] = drawn.exact[:, 2:]
    if origin:
        A[:, :3, 3] -= 1.0
    noise = (SIGMA, ANGLE if lines else 1e-5)
    data = {"T_base_tool": A, "scans": scans, "plane": drawn.plane, "noise": noise, "robust": wrong}
    exact = {"T_base_tool": A[bad:], "scans": drawn.exact[bad:], "plane": drawn.plane[bad:], "noise": noise}
    return data, exact, drawn.X


def _judged(name: str, runs: int, guess: bool = False, lines: bool = True, wrong: bool = False) -> str:
    e2, bound, nees, lengths = np.zeros(2), np.zeros(2), [], []
    failed = missed = false = 0
    for run in range(runs):
        data, exact, X = _draw(run, lines, wrong)
        if guess:
            rng = np.random.default_rng([4000, run, 1])
            angles = np.radians(60.0) * (rng.random(3) - 0.5)
            data["start"] = se3.from_rp(turns(angles), 0.4 * (rng.random(3) - 0.5)) @ X
        try:
            fit = fit_laser_plane(**data)
        except ArmlabError:
            failed += 1
            continue
        found = fit.value.T_tool_sensor
        e = np.concatenate([found[:3, 3] - X[:3, 3], so3.log(X[:3, :3].T @ found[:3, :3])])
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
        f"{name}: {runs - failed} of {runs} runs; rotation {rotation:.3f} of {np.degrees(size[0]):.4f} deg, position "
        f"{position:.3f} of {1e3 * size[1]:.4f} mm (median error {1e3 * np.median(lengths):.3f} mm); NEES "
        f"{np.mean(nees):.3f}{flags}."
    )


def _origin(runs: int) -> str:
    worst = 0.0
    for run in range(runs):
        one, other = (fit_laser_plane(**_draw(run, origin=moved)[0]).value.T_tool_sensor for moved in (False, True))
        worst = max(worst, float(np.abs(one - other).max()))
    return f"L4, plates through the origin: X moves by at most {worst:.1e} in {runs} runs."
