"""``armlab plot``: figures of what was saved."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, Parameter

__all__ = ["dmp", "plot"]

plot = App(name="plot", help="Figures of what was saved: a movement primitive.")


@plot.command
def dmp(
    primitive: Path,
    *,
    output: Annotated[Path, Parameter(alias="-o")],
    demo: Path | None = None,
    column: str = "q",
    phase: bool = False,
    force: bool = False,
) -> int:
    """Draw a movement primitive: position, velocity, forcing, kernels and weights over time.

    Parameters
    ----------
    primitive : Path
        File of `armlab dmp fit`.
    output : Path
        PNG, SVG or PDF.
    demo : Path
        Log of what it was taught, drawn dotted.
    column : str
        What moved in that log.
    phase : bool
        Draw velocity over position instead.
    force : bool
        Replace an existing file.
    """
    from armlab import log as files
    from armlab import plots
    from armlab.cli.output import FIGURES, check_output, note
    from armlab.motion import Dmp

    check_output(output, force, FIGURES)
    motion = Dmp.load(primitive)
    figure: Any
    if phase:
        figure = plots.dmp_phase(motion).figure
    else:
        table = None if demo is None else files.read(demo)
        figure = plots.dmp(motion, None if table is None else (table.t, table[column]))
    figure.savefig(output, dpi=150)
    note(f"figure: {output}")
    return 0
