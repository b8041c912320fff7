"""Report of ``armlab estimate``: tables of axes and contacts, verdict, and HTML page."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

import armlab
from armlab.cli.support.html_report import HtmlReport, Verdict
from armlab.cli.support.log_input import gaps, left_out
from armlab.cli.support.results import Tell
from armlab.errors import UnknownName

if TYPE_CHECKING:
    from armlab.contact.contacts import Contact, Hypotheses
    from armlab.log import Table
    from armlab.models import TorqueModel

COLUMNS = ("wrench_hat", "wrench_hat_cov", "observability", "wrench_flags", "wrench_active", "wrench_interval")
MOTION = ("q", "qd", "tau")  # needed by armlab view to show the arm of an estimate
AXES = ("f_x", "f_y", "f_z", "m_x", "m_y", "m_z")


def axes(table: Table) -> list[dict[str, float | str]]:
    """Return the range, RMS, mean 2-sigma band and observability of each wrench axis."""
    F, observability = table["wrench_hat"], table["observability"]
    sigma = np.sqrt(np.einsum("kii->ki", table["wrench_hat_cov"]))
    return [
        {
            "axis": AXES[i],
            "min": float(np.nanmin(F[:, i])),
            "max": float(np.nanmax(F[:, i])),
            "rms": float(np.sqrt(np.nanmean(F[:, i] ** 2))),
            "two_sigma": float(2 * np.nanmean(sigma[:, i])),
            "observability": float(np.nanmean(observability[:, i])),
            **_limits(table, i),
        }
        for i in range(6)
    ]


def _limits(table: Table, axis: int) -> dict[str, float]:
    """Return the median limits of an axis, and the fraction of rows in which the limits exclude zero."""
    if "wrench_interval" not in table:
        return {}
    low, high = table["wrench_interval"][:, axis].T
    if not np.isfinite(low).any():
        return {"limit_low": np.nan, "limit_high": np.nan, "proven": 0.0}
    proven = float(np.mean((low > 0) | (high < 0)))
    return {"limit_low": float(np.nanmedian(low)), "limit_high": float(np.nanmedian(high)), "proven": proven}


def limits(table: Table, contact: Contact) -> list[tuple[float, float]]:
    """Return the median limits of the force in x, y, z during a contact; empty unless the method is "interval"."""
    if "wrench_interval" not in table:
        return []
    inside = table["wrench_interval"][(table.t >= contact.start) & (table.t <= contact.end), :3]
    inside = inside[np.isfinite(inside).all(axis=(1, 2))]
    return [(float(low), float(high)) for low, high in np.median(inside, axis=0)] if len(inside) else []


def rows(table: Table) -> list[tuple[str, ...]]:
    words = {"min": "min", "max": "max", "rms": "rms", "two_sigma": "2-sigma", "observability": "observability"}
    if "wrench_interval" in table:
        words |= {"limit_low": "limit from", "limit_high": "limit to", "proven": "fraction beyond zero"}
    lines = ((str(axis["axis"]), *(f"{axis[key]:.2f}" for key in words)) for axis in axes(table))
    return [("axis", *words.values()), *lines]


def columns(table: Table, believed: Hypotheses | None) -> Table:
    """Return the output columns of an estimate, with the probability of each contact location.

    The columns p_none, p_point, p_link_1, ... are the probabilities in the window nearest to the row.
    """
    written = table.select(*(name for name in (*COLUMNS, *MOTION) if name in table))
    if believed is not None:
        middles = 0.5 * (believed.t[1:] + believed.t[:-1])
        nearest = np.searchsorted(middles, table.t)
        for k, name in enumerate(believed.names):
            written = written.with_column(f"p_{name.replace(' ', '_')}", believed.posterior[nearest, k], unit="1")
    return written


def places(contacts: Sequence[Contact], believed: Hypotheses | None) -> list[tuple[Contact, str]]:
    return [(c, "" if believed is None else believed.during(c.start, c.end)) for c in contacts]


def contact_rows(table: Table, contacts: Sequence[Contact], believed: Hypotheses | None) -> list[tuple[str, ...]]:
    """Return the rows of the contact table, header first; forces include the limits of the method "interval"."""
    found: list[tuple[str, ...]] = [
        ("from [s]", "to [s]", "f_x [N]", "f_y [N]", "f_z [N]", "2-sigma [N]", "possible location")
    ]
    for c, place in places(contacts, believed):
        within = [f" ({low:+.2f} to {high:+.2f})" for low, high in limits(table, c)] or [""] * 3
        forces = (f"{force:+.2f}{limit}" for force, limit in zip(c.force, within, strict=True))
        found.append((f"{c.start:.2f}", f"{c.end:.2f}", *forces, f"{c.band:.2f}", place or "-"))
    return found


SEEN, WEAK = 0.9, 0.5  # observability
SLOW = 0.01  # rad/s, largest joint speed at rest
OFTEN = 0.05  # minimum fraction of rows that is reported
HONEST = 0.90  # minimum fraction of errors inside 2 sigma
NAMED = 3  # number of longest gaps that are listed


def judge(
    table: Table, model: TorqueModel, prior: np.ndarray, contacts: Sequence[Contact], doubts: Sequence[str] = ()
) -> Verdict:
    """Return the verdict on an estimate, with advice; `prior`: variances (6,)."""
    advice = ["Correct the log first: forces estimated from it are unreliable."]
    found = Verdict(bad=list(doubts), ahead=advice if doubts else [])
    if contacts:
        largest = max(contacts, key=lambda contact: float(np.linalg.norm(contact.force)))
        size = float(np.linalg.norm(largest.force))
        span = f"{largest.start:.2f} to {largest.end:.2f} s"
        found.good.append(
            f"{len(contacts)} contact{'s' if len(contacts) > 1 else ''}; the strongest lasts from {span}, with "
            f"{size:.2f} N (2 sigma: {largest.band:.2f} N)."
        )
    else:
        found.good.append("No contact: the force never exceeds its level in free motion.")
    for part in (_seen, _whole, _flags):
        part(found, table)
    _reach(found, table, model, prior)
    _truth(found, table)
    if doubts:
        found.good.clear()
    return found


def _seen(found: Verdict, table: Table) -> None:
    observability = table["observability"]
    known = np.isfinite(observability).all(axis=1)
    mean = observability[known].mean(axis=0)
    weak = (observability[known] < WEAK).mean(axis=0)
    seen = [AXES[i] for i in range(6) if mean[i] >= SEEN]
    if seen:
        found.good.append(f"Well observable: {', '.join(seen)} (mean {mean[mean >= SEEN].min():.2f} or more).")
    hidden = [f"{AXES[i]} ({100 * weak[i]:.0f} % of the time)" for i in range(6) if weak[i] > OFTEN]
    if hidden:
        found.bad.append(f"Poorly observable, dominated by the prior: {', '.join(hidden)}.")
        still = np.asarray((np.abs(table["qd"][known]) < SLOW).all(axis=1))
        hard = (observability[known] < WEAK).any(axis=1)
        if np.mean(still[hard]) > 0.5:
            found.ahead.append("Move the joints slightly (identify.dither): at rest, static friction masks the force.")
        else:
            found.ahead.append("Use a pose farther from singularities, or --point with a known contact point.")


def _whole(found: Verdict, table: Table) -> None:
    if count := left_out(table):
        t = table.t[(table["wrench_flags"] & armlab.contact.INVALID) > 0]
        found.bad.append(
            f"{count} of {len(table)} rows ({100 * count / len(table):.1f} %), between {t[0]:.2f} and {t[-1]:.2f} s, "
            "contain non-finite values and have no estimate."
        )
    if holes := gaps(table):
        longest = sorted(sorted(holes, key=lambda gap: -gap[1])[:NAMED])
        named = ", ".join(f"{seconds:.3g} s after {after:.2f} s" for after, seconds in longest)
        more = f", {len(holes) - NAMED} shorter ones" if len(holes) > NAMED else ""
        total = sum(seconds for _, seconds in holes)
        found.bad.append(
            f"{'Gap' if len(holes) == 1 else f'{len(holes)} gaps'} in the log: {named}{more}; {total:.3g} s in total. "
            "Contacts during gaps are missed, and the estimate restarts after a gap of more than five sample periods."
        )


def _flags(found: Verdict, table: Table) -> None:
    from armlab.contact import INFEASIBLE, SINGULAR, STUCK

    flags = table["wrench_flags"]
    share = {flag: float(np.mean((flags & flag) != 0)) for flag in (STUCK, INFEASIBLE, SINGULAR)}
    if share[SINGULAR]:
        found.bad.append(f"{100 * share[SINGULAR]:.1f} % of the rows are at singular poses and have no estimate.")
        found.ahead.append("For singular poses, choose a method with a prior (map, bounded).")
    if share[STUCK] > OFTEN:
        found.bad.append(
            f"In {100 * share[STUCK]:.0f} % of the rows, every joint torque is within its friction bound, which may "
            "mask a force."
        )
        found.ahead.append(
            "Use the limits for these rows: see the tables, the dotted lines in the figure, and wrench_interval in the "
            "output file."
            if "wrench_interval" in table
            else "For these rows, use the limits of --method interval."
        )
    if share[INFEASIBLE]:
        found.bad.append(
            f"In {100 * share[INFEASIBLE]:.1f} % of the rows, no wrench at the tool explains the torques: the contact "
            "is on another link, or the model is wrong."
        )


def _reach(found: Verdict, table: Table, model: TorqueModel, prior: np.ndarray) -> None:
    """Report where the log exceeds the training range of the model, and where the prior shrinks the estimate."""
    if away := armlab.identify.extrapolation(model, table.dropna("q", "qd")).warnings:
        found.bad += away
        found.ahead.append(
            "Repeat the identification with motions that cover the range "
            "of this log; until then, use the estimated forces with care."
        )
    largest = np.nanmax(np.abs(table["wrench_hat"]) / np.sqrt(prior), axis=0)
    beyond = [AXES[i] for i in range(6) if largest[i] > 2]
    if beyond:
        found.bad.append(
            f"Estimates larger than twice the prior: {', '.join(beyond)}. These estimates are biased towards zero."
        )
        found.ahead.append("Increase --prior-force or --prior-moment.")


def _truth(found: Verdict, table: Table) -> None:
    """Compare the estimate with the wrench of a force sensor or a simulated operator, if the log contains such a
    wrench."""
    try:
        compared = armlab.contact.compare(table)
    except UnknownName:
        return
    text = compared.text()
    (found.good if np.mean(compared.inside[:3]) >= HONEST else found.bad).append(f"{text[0].upper()}{text[1:]}.")


def page(
    table: Table, verdict: Verdict, contacts: Sequence[Contact], believed: Hypotheses | None, about: str, tell: Tell
) -> HtmlReport:
    page = HtmlReport("Contact wrench", about)
    page.verdict(verdict)
    words = (
        "Wrench exerted by the environment on the robot, in base axes, at the tool point [N, N m]. Observability: "
        "1 if determined by the torques, 0 if determined by the prior."
    )
    if "wrench_interval" in table:
        words += " Limits: medians over all rows, and the fraction of rows in which the limits exclude zero."
    page.section("Per axis", words)
    page.table(rows(table))
    page.section("Contacts", "" if contacts else "None: the force never exceeds its level in free motion.")
    if contacts:
        page.table(contact_rows(table, contacts, believed))
    page.figures([(title, title, caption, draw) for title, caption, draw in _drawings(table, believed)], tell)
    return page


def _drawings(table: Table, believed: Hypotheses | None) -> list[tuple[str, str, Any]]:
    """Return the title, caption and drawing function of each figure."""
    shown = [
        (
            "Wrench over time",
            "Line: estimate. Band: two sigma. Shaded: contact, where zero is outside the 95 % ellipsoid.",
            lambda: armlab.plots.wrench(table),
        ),
        (
            "Observability over time",
            "Observability depends on the pose and on joint friction. "
            "Shaded: the observability of at least one axis is below 0.5.",
            lambda: armlab.plots.observability(table),
        ),
        (
            "Motion",
            "Positions, velocities and torques of the log.",
            lambda: armlab.plots.table(table, "q", "qd", "tau"),
        ),
    ]
    if believed is not None:
        where = (
            "Contact location",
            "Probability of each location, in windows of one second. Bar at the top: contact on a link cannot be "
            "excluded at odds of 400 to 1.",
            lambda: armlab.plots.hypotheses(believed),
        )
        shown.insert(1, where)
    if "wrench_true" in table or "wrench" in table:
        coverage = (
            "Coverage by speed",
            "Fraction of errors per axis inside two sigma: 95.4 % "
            "at every speed if the uncertainty is well calibrated.",
            lambda: armlab.plots.coverage(table),
        )
        shown.insert(-1, coverage)
    return shown
