"""Output of commands that fit or estimate: HTML page, figure, JSON."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cyclopts import Parameter

import armlab
from armlab.cli import DOUBTFUL
from armlab.cli.support.output import FIGURES, check_output, note, print_json, progress, result, save_figure

if TYPE_CHECKING:
    from armlab.cli.support.html_report import HtmlReport, Verdict
    from armlab.estimation import Fit

Tell = Callable[[float, float, str], None]


@Parameter(name="*")
@dataclass(frozen=True)
class Results:
    """Output files and format.

    Attributes:
        report: Also write a self-contained .html page with tables and figures, which loads nothing from the network.
        figure: Also save a figure of the result to this PNG, SVG or PDF file.
        json: Print JSON for scripts.
        force: Replace existing files, save a poor result, and accept a recording or model made with another description
            of the arm. With `identify`: also accept implausible torques.
    """

    report: Path | None = None
    figure: Path | None = None
    json: bool = False
    force: bool = False

    def check(self, output: Path | None, endings: Sequence[str], inputs: Sequence[Path] = ()) -> None:
        """Reject invalid output files, before any computation."""
        for path, known in ((output, endings), (self.report, (".html",)), (self.figure, FIGURES)):
            if path is not None:
                check_output(path, self.force, known, inputs)

    def say(self, numbers: Mapping[str, Any], text: str, verdict: Verdict) -> None:
        """Print the result with its verdict, as text or as JSON."""
        if self.json:
            print_json({**numbers, "verdict": vars(verdict)})
        else:
            result(f"{text}\n\n{verdict.text()}")

    def keep(self, verdict: Verdict, saves: Mapping[Path, Callable[[Path], object]]) -> int:
        """Save the result unless it is poor and --force is missing; return the exit code of the command."""
        if saves and verdict.bad and not self.force:
            names = ", ".join(map(str, saves))
            note(f"not saved because the result is poor: {names}. Follow the advice, or add --force to save it anyway.")
            return DOUBTFUL
        for path, save in saves.items():
            save(path)
            note(f"saved: {path}")
        return 0

    def write(self, draw: Callable[[Any], Any], page: Callable[[Tell], HtmlReport]) -> None:
        """Write the figure and the page if requested; `draw` receives the module `armlab.plots`."""
        if self.figure is not None:
            save_figure(draw(armlab.plots), self.figure)
            note(f"figure: {self.figure}")
        if self.report is not None:
            with progress("report") as tell:
                page(tell).write(self.report)
            note(f"report: {self.report}")


PLAIN = Results()


def parameters(fit: Fit[Any]) -> list[dict[str, Any]]:
    """Return the parameters of a fit for JSON output."""
    columns = zip(fit.names, fit.parameters, fit.sd, fit.units, strict=True)
    return [{"name": name, "value": value, "sd": sd, "unit": unit} for name, value, sd, unit in columns]
