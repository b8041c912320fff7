"""``armlab identify``: identify a torque model from logs of free motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import armlab
from armlab.cli.support.options import Columns, Output, load_robot
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
    output: Output,
    method: Literal["irls", "wls", "ols", "lts"] = "irls",
    gravity_only: bool = False,
    drives: bool = False,
    cutoff: float | None = None,
    test: Path | None = None,
    columns: Columns = None,
    wanted: Results = PLAIN,
) -> int:
    """Identify gravity, inertia and friction from logs; save the model.

    Prints a table per joint, and a verdict with advice for the next log. A poor model is saved only with --force;
    otherwise the exit status is 3. If the logs do not determine the model, the exit status is 1.

    Parameters:
        robot: Name in the library, or a robot file.
        logs: Recordings of free motion without contact, with positions, velocities and torques, for example from armlab
            excite.
        output: Model file to write, .toml.
        method: irls: robust (iteratively reweighted least squares). lts: robust (least trimmed squares, ignoring the
            worst quarter of the segments). wls, ols: not robust, with or without a weight per joint.
        gravity_only: Identify only gravity and friction, from a log of slow motion (accelerations below 1 rad/s^2). Use
            this option for an arm that must not move fast; the model is accurate enough to estimate contact forces in
            slow motion. Default: also identify inertia, which needs a log of fast motion.
        drives: Also identify torque ripple, position-dependent friction and (with logs of at least 20 minutes) warm-up
            per joint. Only terms that reduce the held-out residual are kept.
        cutoff: Cut-off frequency of the regression filter [Hz]; default: chosen by cross-validation (see the report).
        test: Another recording without contact, to test the model.
    """
    from armlab.cli.identify import report as report_of
    from armlab.cli.support.log_input import read_log
    from armlab.identify.record import check_once

    arm = load_robot(robot)
    if not logs:
        raise ConfigError(
            "Expected at least one log to identify from, got none. Pass at least one recording of a motion."
        )
    wanted.check(output, [".toml"])
    tables = [read_log(path, arm, wanted.force, columns, fit=True) for path in logs]
    unseen = None if test is None else read_log(test, arm, wanted.force, columns, fit=True)
    if test is not None and unseen is not None:
        names = [path.name for path in (*logs, test)]
        check_once(zip(names, (one.sha256 for one in (*tables, unseen))))
    with progress("identify") as tell:
        fit_model = armlab.identify.fit_gravity if gravity_only else armlab.identify.fit_dynamics
        fit = fit_model(tables, arm, method=method, progress=tell, cutoff=cutoff, force=wanted.force)
        if drives:
            tell(4, 5, "ripple, position-dependent friction, warm-up")
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
    """Return the fit with the drive terms that improve it; if identification fails, add the reason to `doubts`."""
    try:
        return replace(fit, value=armlab.identify.fit_friction(tables, fit.value).value)
    except (NotExcited, ShapeError) as error:
        return replace(fit, doubts=(*fit.doubts, f"Drives: {error}"))
