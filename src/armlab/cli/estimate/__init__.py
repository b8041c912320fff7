"""``armlab estimate``: estimate the contact wrench in a log, with its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from cyclopts import Parameter

import armlab
from armlab.cli.support.options import Columns, ForceMethod, OptionalOutput, as_given, load_robot
from armlab.cli.support.output import aligned, note, print_json, progress, result
from armlab.cli.support.results import PLAIN, Results
from armlab.errors import LogError

if TYPE_CHECKING:
    from armlab.cli.support.html_report import Verdict
    from armlab.contact.contacts import Contact, Hypotheses
    from armlab.log import Table
    from armlab.robots import Robot

__all__ = []

LEAST = 1.0  # s, shortest log in which contacts are located


@Parameter(name="*")
@dataclass(frozen=True)
class ContactPrior:
    """Prior knowledge about the contact.

    Attributes:
        prior_force: Expected magnitude of the force per axis, as a standard deviation [N].
        prior_moment: Expected magnitude of the moment per axis, as a standard deviation [N m].
        point: Known contact point in tool axes [m]: x y z, within the length of the arm.
    """

    prior_force: float = 20.0
    prior_moment: float = 2.0
    point: tuple[float, float, float] | None = None

    @property
    def deviations(self) -> list[float]:
        return [self.prior_force] * 3 + [self.prior_moment] * 3


def estimate(
    robot: str,
    log: Path,
    *,
    model: Path,
    method: ForceMethod = "map",
    force_rate: Literal["smooth", "normal", "fast"] | None = None,
    bias: bool = False,
    tare: float | None = None,
    columns: Columns = None,
    output: OptionalOutput = None,
    prior: ContactPrior = ContactPrior(),
    wanted: Results = PLAIN,
) -> int:
    """Estimate the contact force in a log with a torque model.

    For each axis, prints the range, the mean 2-sigma band, the observability and, with --method interval, the limits.
    For each contact, prints the mean force and the possible contact location. A verdict then reports gaps and skipped
    rows. Forces are exerted by the environment on the robot, in base axes at the tool point.

    Parameters:
        robot: Library name or robot file of the modelled robot.
        log: Recording of this robot with positions, velocities and torques.
        model: Model file written by `armlab identify`.
        method: map: most probable force, for continuous motion. bounded: no contact unless proven, for an arm that also
            stops. interval: like bounded, with guaranteed limits. kf, observer: momentum methods, which need no
            acceleration. ls, lund, clip, ols: for comparison.
        force_rate: With method kf: expected rate of change of the force.
        bias: With method kf: estimate a friction error per joint, reset after each stop.
        tare: Duration of the initial period in which the arm is at rest without contact [s]. The friction identified
            during this time is valid until the arm moves.
        output: Also write the estimate of every row, together with q, qd and tau, to this .mcap (for armlab view) or
            .csv file.
        prior: Prior of the contact wrench.
    """
    from armlab.cli.estimate import report as report_of
    from armlab.cli.support.log_input import doubts, model_for, read_log

    wanted.check(output, (".mcap", ".csv"), [log])
    arm = load_robot(robot)
    known = model_for(model, arm, wanted.force)
    options = {"force_rate": force_rate, "bias": bias}
    with as_given():
        estimator = armlab.contact.Estimator(known, arm, method, prior.deviations, prior.point, **options)
    with progress("estimate") as tell:
        tell(0, 1, "reading the log")
        table = estimator.run(read_log(log, arm, wanted.force, columns), tare=tare, progress=tell)
        _check(table, log)
        found = armlab.contact.contacts(table)
        tell(0, 2, "contact location")
        believed = _believed(table, arm, method, prior) if found else None
        tell(1, 2, "verdict")
        verdict = report_of.judge(table, known, estimator.prior, found, doubts(table, arm, known))
        tell(1, 1, "done")
    _say(table, method, report_of.places(found, believed), verdict, wanted.json)
    if output is not None:
        note(f"writing {output}")
        armlab.log.write(report_of.columns(table, believed), output, arm)
    about = f"{log.name} of {arm.name}, model {model.name}, method {method}."
    wanted.write(
        lambda plots: plots.wrench(table), lambda tell: report_of.page(table, verdict, found, believed, about, tell)
    )
    return 0


def _believed(table: Table, arm: Robot, method: str, prior: ContactPrior) -> Hypotheses | None:
    """Return the contact locations, or None for short logs and momentum methods."""
    if method in ("observer", "kf") or table.t[-1] - table.t[0] < LEAST:
        return None
    return armlab.contact.hypotheses(table, arm, point=prior.point, prior=prior.deviations)


def _say(table: Table, method: str, found: list[tuple[Contact, str]], verdict: Verdict, json: bool) -> None:
    """Print the table of the axes, the contacts with their locations, and the verdict, as text or as JSON."""
    from armlab.cli.estimate.report import axes, limits, rows
    from armlab.cli.support.log_input import gaps, left_out

    if json:
        print_json(
            {
                "rows": len(table),
                "left_out": left_out(table),
                "gaps": [{"after": after, "seconds": seconds} for after, seconds in gaps(table)],
                "method": method,
                "contacts": [{**vars(contact), "where": place} for contact, place in found],
                "axes": axes(table),
                "verdict": vars(verdict),
            }
        )
        return
    head, *lines = rows(table)
    result(aligned([head, *lines], right=range(1, len(head))))
    for contact, place in found:
        f = "  ".join(f"{value:+.2f}" for value in contact.force)
        span = f"{contact.start:7.2f} to {contact.end:7.2f} s"
        result(f"contact {span}   force [N]  {f}   2-sigma {contact.band:.2f}   {place}".rstrip())
        if within := limits(table, contact):
            result(f"        {' ' * len(span)}   limits [N]  {'   '.join(f'{a:+.2f} .. {b:+.2f}' for a, b in within)}")
    result(verdict.text())


def _check(table: Table, log: Path) -> None:
    """Reject a log without usable rows; otherwise, report the number of unusable rows."""
    import numpy as np

    from armlab.cli.support.log_input import left_out

    invalid = left_out(table)
    if invalid == len(table):
        never = [name for name in ("q", "qd", "tau") if not np.isfinite(table[name]).all(axis=1).any()]
        advice = (
            "Record with the research extension, which sends torques. A simulated arm needs masses in its description."
            if never == ["tau"]
            else f"Never finite: {', '.join(never) or 'all three in one row'}. Record again."
        )
        raise LogError(f"Expected rows with finite q, qd and tau in {log}, got none in {len(table)} rows. {advice}")
    if invalid:
        note(f"{invalid} of {len(table)} rows contain non-finite values and have no estimate")
