"""``armlab estimate``: the contact wrench in a log, with its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

import armlab
from armlab.cli.support.options import ForceMethod, as_given
from armlab.cli.support.output import aligned, note, print_json, progress, result
from armlab.cli.support.results import PLAIN, Results
from armlab.errors import LogError

if TYPE_CHECKING:
    from armlab.cli.support.html_report import Verdict
    from armlab.contact.contacts import Contact, Hypotheses
    from armlab.log import Table
    from armlab.robots import Robot

__all__ = []


LEAST = 1.0  # s of a log in which the place of a contact is weighed


@Parameter(name="*")
@dataclass(frozen=True)
class ContactPrior:
    """What was known of the contact before.

    Attributes:
        prior_force: How large a force is expected in each axis: its standard deviation [N].
        prior_moment: The same of the moment [N m].
        point: Where the contact is, in tool axes [m], when that is known: x y z, within the length of the arm.
    """

    prior_force: float = 20.0
    prior_moment: float = 2.0
    point: tuple[float, float, float] | None = None

    @property
    def deviations(self) -> list[float]:
        """Standard deviations (6,) [N, N m]."""
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
    output: Annotated[Path | None, Parameter(alias="-o")] = None,
    prior: ContactPrior = ContactPrior(),
    wanted: Results = PLAIN,
) -> int:
    """Estimate the contact force in a log with a model.

    Prints, per axis, the range of the estimate, its mean 2-sigma band and how well the arm could see that axis (with
    --method interval also the limits), then each interval of contact with its mean force and where it may be, then
    what can be relied on and what cannot, with gaps and rows that were left out. The force is that of the environment
    on the robot, in base axes, at the tool point.

    Parameters:
        robot: Name in the library, or a robot file; the one the model belongs to.
        log: Recording with positions, velocities and torques.
        model: Model file of `armlab identify`.
        method: map: most probable force, for motion. bounded: no contact unless proven, for an arm that also rests.
            interval: bounded, with limits that hold. kf, observer: momentum, which needs no acceleration. ls, lund,
            clip: to compare.
        force_rate: Of the method kf: how fast the force may change.
        bias: Of the method kf: friction that is unknown after a rest is a state of its own.
        tare: Seconds from the beginning in which the arm rests without contact: friction is known until it moves.
        output: Also write the estimate of every row, ends in .mcap or .csv.
        prior: Of the contact.
    """
    from armlab.cli.estimate import report as report_of
    from armlab.cli.support.log_input import doubts, read_log

    wanted.check(output, (".mcap", ".csv"), [log])
    arm = armlab.robots.load(robot)
    known = armlab.models.load(model, "torque_model")
    options = {"force_rate": force_rate, "bias": bias}
    with as_given():
        estimator = armlab.contact.Estimator(known, arm, method, prior.deviations, prior.point, **options)
    with progress("estimate") as tell:
        tell(0, 1, "reading the log")
        table = estimator.run(read_log(log, arm), tare=tare, progress=tell)
        _check(table, log)
        found = armlab.contact.contacts(table)
        tell(0, 2, "where the contact may be")
        believed = _believed(table, arm, method, prior) if found else None
        tell(1, 2, "what can be relied on")
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
    """Return what is believed of the place of contacts; nothing of methods whose torque error is not static."""
    if method in ("observer", "kf") or table.t[-1] - table.t[0] < LEAST:
        return None
    return armlab.contact.hypotheses(table, arm, point=prior.point, prior=prior.deviations)


def _say(table: Table, method: str, found: list[tuple[Contact, str]], verdict: Verdict, json: bool) -> None:
    """Print the table per axis, the contacts with their places and the verdict, or all of it as JSON."""
    from armlab.cli.estimate.report import axes, limits, rows
    from armlab.cli.support.log_input import gaps, left_out

    if json:
        contacts = [{**vars(contact), "where": place} for contact, place in found]
        missing = [{"after": after, "seconds": seconds} for after, seconds in gaps(table)]
        said = {"rows": len(table), "left_out": left_out(table), "gaps": missing, "method": method}
        said |= {"contacts": contacts, "axes": axes(table)}
        print_json({**said, "verdict": vars(verdict)})
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
    """Refuse a log without a row that could be estimated; say how many could not."""
    import numpy as np

    from armlab.cli.support.log_input import left_out

    invalid = left_out(table)
    if invalid == len(table):
        never = [name for name in ("q", "qd", "tau") if not np.isfinite(table[name]).all(axis=1).any()]
        advice = (
            "Record with the research extension, which sends torques."
            if never == ["tau"]
            else f"Never finite: {', '.join(never) or 'all three in one row'}. Record again."
        )
        raise LogError(f"Expected rows with finite q, qd, tau in {log}, got none among {len(table)}. {advice}")
    if invalid:
        note(f"{invalid} of {len(table)} rows are not finite and have no estimate")
