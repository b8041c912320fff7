"""``armlab identify``: from logs of free motion to a model file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

import armlab
from armlab.cli.support.output import progress
from armlab.cli.support.results import PLAIN, Results
from armlab.errors import ConfigError, NotExcited, ShapeError

if TYPE_CHECKING:
    from armlab.estimation import Fit
    from armlab.log import Table
    from armlab.models import TorqueModel

__all__ = []


def identify(
    robot: str,
    *logs: Path,
    output: Annotated[Path, Parameter(alias="-o")],
    method: Literal["irls", "wls", "ols", "lts"] = "irls",
    gravity_only: bool = False,
    drives: bool = False,
    cutoff: float | None = None,
    test: Path | None = None,
    wanted: Results = PLAIN,
) -> int:
    """Identify gravity, inertia and friction from logs; save the model.

    Prints a table per joint and a verdict: what is good, what is not, what to log next. A model that is not good
    is saved with --force only, else the command ends with status 3; logs that do not determine it end it with status 1.

    Parameters:
        robot: Name in the library, or a robot file.
        logs: Recordings of free motion without contact, with positions, velocities and torques; armlab excite makes
            one.
        output: Model file to write, ends in .toml.
        method: irls: outliers count less. lts: a quarter of the stretches of time, those that fit worst, is left out.
            wls, ols: every sample as it is, with or without a weight per joint.
        gravity_only: Gravity and friction alone, from a log of slow motion (accelerations below 1 rad/s^2), for an arm
            that may not move fast: enough for contact forces in slow motion. Without: also inertia, which takes a log
            of fast motion.
        drives: Also look for lines of torque ripple, friction over position and warm-up (logs from 20 minutes), joint
            by joint; what wins on held-out stretches of time is kept. Where the logs do not determine them, the verdict
            says so and the model has none.
        cutoff: Corner of the regression in Hz. Default: chosen on held-out stretches of time; the report says why.
        test: Another recording without contact: how good the model is where it was not fitted.
    """
    from armlab.cli.identify import report as report_of
    from armlab.cli.support.log_input import read_log
    from armlab.identify.record import check_once

    arm = armlab.robots.load(robot)
    if not logs:
        raise ConfigError("Expected at least one log to identify from, got none. Give the files of recorded motions.")
    wanted.check(output, [".toml"])
    tables = [read_log(path, arm) for path in logs]
    unseen = None if test is None else read_log(test, arm)
    if test is not None and unseen is not None:
        names = [path.name for path in (*logs, test)]
        check_once(zip(names, (one.sha256 for one in (*tables, unseen))))
    with progress("identify") as tell:
        fit_model = armlab.identify.fit_gravity if gravity_only else armlab.identify.fit_dynamics
        fit = fit_model(tables, arm, method=method, progress=tell, cutoff=cutoff, force=wanted.force)
        if drives:
            tell(4, 5, "ripple, friction over position, warm-up")
            fit = _with_drives(fit, tables)
    trial = report_of.try_out(fit.value, arm, tables[0] if unseen is None else unseen, unseen is not None)
    verdict = report_of.judge(fit, arm, tables, trial)
    wanted.say({"model": str(output), **report_of.numbers(fit, trial)}, fit.report(), verdict)
    code = wanted.keep(verdict, {output: fit.save})
    seconds, kind = fit.value.quality.seconds, ", gravity and friction only" if gravity_only else ""
    about = f"From {', '.join(path.name for path in logs)}, {seconds:.0f} s of motion, method {method}{kind}."
    wanted.write(
        lambda plots: plots.torque_fit(fit, trial.log),
        lambda tell: report_of.page(fit, verdict, trial, tables[0], about, tell),
    )
    return code


def _with_drives(fit: Fit[TorqueModel], tables: Sequence[Table]) -> Fit[TorqueModel]:
    """Return the fit with parts of the drives that win; without them, and with the reason, where that is refused."""
    try:
        return replace(fit, value=armlab.identify.fit_friction(tables, fit.value).value)
    except (NotExcited, ShapeError) as error:
        return replace(fit, doubts=(*fit.doubts, f"Drives: {error}"))
