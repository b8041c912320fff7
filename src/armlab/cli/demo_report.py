"""What the demo says at the end: a table per press, bars, figures, a summary file."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from armlab.cli.output import aligned
from armlab.errors import LogError

if TYPE_CHECKING:
    from armlab.cli.demo import Plan
    from armlab.log import Table

__all__ = ["Verdict", "figures", "judge", "latency_line"]

SEEN = 0.9  # observability from which an axis counts
MAX_RMS = 1.5  # N per axis, with contact and in free motion
MAX_PRESS_ERROR = 0.15  # of 500 g, mean of the press
COVERAGE = (0.85, 0.99)
MAX_HOLES = 0.02  # share of cycles without an estimate: overtaken or late ones of a busy machine
AXES = "xyz"


@dataclass(frozen=True)
class Verdict:
    """How the estimate compares with the operator's forces.

    Attributes
    ----------
    presses : name, true force, estimated force (x, y, z) [N], 2-sigma along the press [N], error along the press [N].
    rms, free_rms : (3,) error with the operator and in free motion [N], where the axis is seen.
    coverage : share of force samples inside 2 sigma while the arm sways and the operator presses.
    rest_inside : share of samples at rest inside 2 sigma. rest_band : their mean 2-sigma (3,) [N].
    holes : share of the cycles of the sway that have no estimate.
    missed : bars that are not met, in words.
    """

    presses: tuple[dict[str, Any], ...]
    rms: np.ndarray
    free_rms: np.ndarray
    coverage: float
    rest_inside: float
    rest_band: np.ndarray
    holes: float
    missed: tuple[str, ...] = field(default=())

    @property
    def passed(self) -> bool:
        """True when every bar is met."""
        return not self.missed

    def text(self) -> str:
        """Return the tables."""
        rows = [("press", "true [N]", "estimated x", "y", "z", "2-sigma", "error")]
        rows += [
            (
                p["name"],
                f"{p['true']:+.2f}",
                *(f"{f:+.2f}" for f in p["force"]),
                f"{p['band']:.2f}",
                f"{p['error']:+.2f}",
            )
            for p in self.presses
        ]
        rms, free, band = (" ".join(f"{v:.2f}" for v in a) for a in (self.rms, self.free_rms, self.rest_band))
        return "\n".join(
            [
                aligned(rows, right=(1, 2, 3, 4, 5, 6)),
                f"force error x y z, RMS while swaying and pressing  {rms} N (bar {MAX_RMS})",
                f"false force x y z, RMS in free motion              {free} N (bar {MAX_RMS})",
                f"inside 2 sigma while swaying and pressing          {100 * self.coverage:.1f} % (bar 85 to 99)",
                f"at rest: inside 2 sigma {100 * self.rest_inside:.1f} %, mean 2-sigma x y z {band} N: "
                "static friction hides small forces",
            ]
        )


def judge(table: Table, plan: Plan) -> Verdict:
    """Compare the recorded live estimate with the operator's forces.

    Parameters
    ----------
    table : log of the second run, with wrench_hat, wrench_hat_cov, observability and session_t.
    plan : what the operator did.

    Raises
    ------
    LogError : when the run ended before the last press.

    Cycles without an estimate do not count; more than MAX_HOLES of them miss a bar.
    """
    estimated = np.asarray(np.isfinite(table["wrench_hat"]).all(axis=1))
    cycles = table["session_t"]
    asked = (cycles >= plan.sway[0]) & (cycles < plan.sway[1])
    holes = float(np.mean(~estimated[asked])) if asked.any() else 1.0
    table = table.where(estimated)
    t = table["session_t"]
    force, truth = table["wrench_hat"][:, :3], plan.wrench(t)[:, :3]
    sigma = np.sqrt(np.einsum("kii->ki", table["wrench_hat_cov"])[:, :3])
    seen = table["observability"][:, :3] >= SEEN
    error = force - truth

    def window(span: tuple[float, float]) -> np.ndarray:
        return (t >= span[0]) & (t < span[1])

    def rms(rows: np.ndarray) -> np.ndarray:
        kept = rows[:, None] & seen
        return np.array([np.sqrt(np.mean(error[kept[:, i], i] ** 2)) if kept[:, i].any() else np.nan for i in range(3)])

    if not len(t) or t[-1] < plan.presses[-1][4]:
        raise LogError(
            f"Expected a run of {plan.presses[-1][4]:.1f} s, with all presses, got {t[-1] if len(t) else 0.0:.1f} s. "
            "Run the demo again."
        )
    sway, rest = window(plan.sway), window(plan.rest)
    presses = []
    for name, axis, true, start, end in plan.presses:
        rows = window((start + 0.1, end))
        mean = force[rows].mean(axis=0)
        band = float(2 * sigma[rows, axis].mean())
        presses.append(
            {"name": name, "true": true, "force": mean.tolist(), "band": band, "error": float(mean[axis] - true)}
        )
    verdict = Verdict(
        presses=tuple(presses),
        rms=rms(sway),
        free_rms=rms(window(plan.free)),
        coverage=float(np.mean(np.abs(error[sway]) < 2 * sigma[sway])),
        rest_inside=float(np.mean(np.abs(error[rest]) < 2 * sigma[rest])),
        rest_band=2 * sigma[rest].mean(axis=0),
        holes=holes,
    )
    return Verdict(**{**vars(verdict), "missed": _missed(verdict)})


def _missed(v: Verdict) -> tuple[str, ...]:
    missed = [
        f"{what} {AXES[i]} {values[i]:.2f} N"
        for what, values in (("force error", v.rms), ("false force", v.free_rms))
        for i in range(3)
        if not values[i] <= MAX_RMS
    ]
    if v.holes > MAX_HOLES:
        missed.append(f"{100 * v.holes:.1f} % of the cycles without an estimate")
    if not COVERAGE[0] <= v.coverage <= COVERAGE[1]:
        missed.append(f"coverage {100 * v.coverage:.1f} %")
    missed += [
        f"{p['name']}: {p['error']:+.2f} N"
        for p in v.presses
        if p["name"].startswith("500 g") and not abs(p["error"]) <= MAX_PRESS_ERROR * abs(p["true"])
    ]
    if not v.rest_inside >= 1.0:
        missed.append(f"truth inside 2 sigma at rest only {100 * v.rest_inside:.1f} %")
    return tuple(missed)


def latency_line(run: Any) -> str:
    """Return the line about the loop: round trip and cycles."""
    return next((line.strip() for line in run.report().splitlines() if "p50" in line), run.report().splitlines()[0])


def figures(folder: Path, outcome: dict[str, Any], verdict: Verdict) -> list[Path]:
    """Write torque.png, wrench.png and summary.json into the folder; return all its files.

    Parameters
    ----------
    folder : of the demo.
    outcome : of `rehearse`.
    verdict : of `judge`.
    """
    from armlab import log, plots

    plan, table = outcome["plan"], outcome["estimate"]
    truth = table.with_column("wrench_true", plan.wrench(table["session_t"]))
    plots.torque_fit(outcome["fit"].value, log.read(folder / "excite.mcap")).savefig(folder / "torque.png", dpi=120)
    plots.wrench(truth).savefig(folder / "wrench.png", dpi=120)
    summary = {
        "passed": verdict.passed,
        "missed": list(verdict.missed),
        "presses": list(verdict.presses),
        "force_rms": verdict.rms.tolist(),
        "false_force_rms": verdict.free_rms.tolist(),
        "coverage": verdict.coverage,
        "rest_inside": verdict.rest_inside,
        "rest_two_sigma": verdict.rest_band.tolist(),
    }
    (folder / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    return sorted(folder.iterdir())
