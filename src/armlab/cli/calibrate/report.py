"""Report of a calibration: verdict in words, JSON, model file, HTML page, figure."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from armlab.cli.support.results import Results

if TYPE_CHECKING:
    from armlab.cli.support.html_report import Verdict
    from armlab.estimation import Fit


_MANY = 0.3  # share of samples beyond which those left out are no outliers
_FEW = 1.5  # measurements per parameter
_ROUGH = {"[m]": 0.01, "[rad]": 0.05}  # beyond it is no noise of a sensor, but records that do not fit


@Parameter(name="*")
@dataclass(frozen=True)
class Wanted(Results):
    """What is wanted of a calibration."""

    output: Annotated[
        Path | None, Parameter(alias="-o", help="Save the result with its covariance, ends in .toml.")
    ] = None

    def save(self, job: str, fit: Fit[Any], sources: tuple[str, ...]) -> None:
        """Print the fit and write the files that are wanted."""
        from armlab.cli.support.output import note

        verdict = judge(fit)
        self.say({**numbers(fit), "sources": list(sources)}, fit.report(), verdict)
        if self.output is not None:
            note(f"calibration: {fit.save(self.output, sources)}")
        self.write(lambda plots: plots.calibration(fit), lambda _: _page(job, fit, verdict, sources))


NOTHING = Wanted()


def numbers(fit: Fit[Any]) -> dict[str, Any]:
    """Return the fit as numbers for scripts."""
    parameters = zip(fit.names, fit.parameters, fit.sd, fit.units, strict=True)
    found = fit.excitation
    return {
        "parameters": [{"name": name, "value": value, "sd": sd, "unit": unit} for name, value, sd, unit in parameters],
        "noise": dict(zip(fit.classes, fit.sigma.ravel().tolist(), strict=False)),
        "samples": fit.n,
        "outliers": fit.outliers.nonzero()[0],
        "excitation": {
            "rank": found.rank, "expected": found.expected, "condition": found.condition, "weakest": found.weakest,
            "held": list(found.held),
        },
    }  # fmt: skip


def judge(fit: Fit[Any]) -> Verdict:
    """Return what can be relied on, what not, and what to do next."""
    import numpy as np

    from armlab.cli.support.html_report import Verdict

    good, bad, ahead = [], [], []
    left, total = int(fit.outliers.sum()), len(fit.outliers)
    good.append(f"{fit.n} samples identify all {fit.excitation.expected} directions asked for.")
    if fit.excitation.held:
        good.clear()
        bad.append(f"A prior fixes what the samples do not identify: {'; '.join(fit.excitation.held)}.")
    if left > _MANY * total:
        bad.append(f"{left} of {total} samples were left out: these are not a few mistakes.")
        ahead.append("Look for the cause in pairing, clocks and units before you use the result.")
    elif left:
        ahead.append(f"Look at the {left} samples that were left out.")
    doubts = [line for line in fit.report().splitlines() if line.endswith("?")]
    bad.extend(f"{line[:1].upper()}{line[1:]}" for line in doubts)
    for name, sigma in zip(fit.classes, fit.sigma.ravel().tolist(), strict=False):
        if sigma > _ROUGH.get(f"[{name.rpartition('[')[2]}", np.inf):
            bad.append(f"Noise of {name} of {sigma:.2g} is no noise of a sensor: some samples are wrong, or all.")
            ahead.append("Look for them with --robust, and check pairing, units and frames.")
    if np.isfinite(fit.residuals).sum() < _FEW * len(fit.names):
        bad.append("There are hardly more measurements than parameters: noise and deviations are guesses.")
        ahead.append("Take more samples.")
    ahead.append(f"The worst direction is {fit.excitation.weakest}; samples that excite it improve most.")
    return Verdict(tuple(good), tuple(bad), tuple(ahead))


def _page(job: str, fit: Fit[Any], verdict: Verdict, sources: tuple[str, ...]) -> Any:
    """Return the page: verdict, figure, parameters, and the text of the fit."""
    from armlab import plots
    from armlab.cli.support.html_report import HtmlReport
    from armlab.plots.style import png

    page = HtmlReport(f"Calibration: {job}", f"From {'; '.join(sources)}.")
    page.verdict(verdict)
    page.section("Residuals, ellipses, excitation", "In standard deviations of the noise; a straight line is normal.")
    page.figure(png(plots.calibration(fit)), "residuals per sample, quantiles, ellipses, singular values")
    page.section("Parameters")
    rows = zip(fit.names, fit.parameters, fit.sd, fit.units, strict=True)
    page.table([
        ["parameter", "value", "deviation", "unit"],
        *([name, f"{value:.6g}", f"{sd:.2g}", unit] for name, value, sd, unit in rows),
    ])  # fmt: skip
    page.section("In words")
    page.verbatim(fit.report())
    return page
