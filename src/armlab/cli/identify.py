"""``armlab identify``: from logs of free motion to a model file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

__all__ = ["identify"]


def identify(
    robot: str,
    *logs: Path,
    output: Annotated[Path, Parameter(alias="-o")],
    figure: Path | None = None,
    force: bool = False,
) -> int:
    """Identify gravity, inertia and friction from logs; save the model.

    Prints a table per joint. Writes nothing when the logs do not determine the model.

    Parameters
    ----------
    robot : str
        Name in the library, or a robot file.
    logs : Path
        Recordings of free motion, without contact.
    output : Path
        Model file to write, ends in .toml.
    figure : Path
        Also draw measured and modelled torques into this PNG, SVG or PDF.
    force : bool
        Replace an existing model file or figure.
    """
    from armlab import log, robots
    from armlab.cli.output import FIGURES, check_output, note, progress, result
    from armlab.errors import ConfigError
    from armlab.identify import fit_dynamics, predict

    arm = robots.load(robot)
    if not logs:
        raise ConfigError("Expected at least one log to identify from, got none. Give the files of recorded motions.")
    check_output(output, force, [".toml"])
    if figure is not None:
        check_output(figure, force, FIGURES)
    tables = [log.read(path) for path in logs]
    with progress("identify") as tell:
        fit = fit_dynamics(tables, arm, progress=tell)
    result(fit.report())
    fit.save(output)
    note(f"model: {output}")
    if figure is not None:
        from armlab import plots

        plots.torque_fit(predict(fit.value, tables[0])).savefig(figure, dpi=150)
        note(f"figure: {figure}")
    return 0
