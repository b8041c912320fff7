"""Markdown reports: a summary table, and all measurements with machine, method and targets."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from blocks import Figure, Table

SCALE = {"µs": 1e6, "ms": 1e3, "s": 1.0, "s of rows": 1.0, "%": 1e2, "N": 1.0}
REASONS = Path(__file__).with_name("missed_targets.toml")
SHARED = 0.1  # cores; above this, the report warns

METHOD = """\
Contenders run in short blocks that alternate in random order, in one process and on the same data, after a check that
they compute the same results. A time is the median over the blocks, with the minimum and the quartiles. The ratio is
armlab's time divided by the contender's in the same round, with the median and quartiles over the rounds; smaller is
better. Times of loops, batches and imports are processor time, which excludes waiting for a
core; times of single steps are wall-clock time. A target is the largest ratio that the project allows, relative to a
contender of the same run; times have no targets. Rows in bold are armlab; rows in italics are limits of the machine.
"""

SUMMARY = """\
Contenders run in alternating blocks on the same data, after a check that they compute the same results. Each row gives
the first measurement of one benchmark: the median of armlab and that of the fastest contender. A ratio below 1 means
that armlab is faster. Targets are the project's own limits for ratios and for values other than times. [All
measurements](benchmarks_all.md) lists every contender with quartiles, every target with the reason for each miss, and
the method.
"""


@dataclass(frozen=True)
class Section:
    """Tables of one benchmark, or the reason for its failure.

    Attributes
    ----------
    other_cores : cores used by other processes during the run. seconds : wall-clock time.
    failure : reason for the failure. earlier : reason for the failure of a first attempt.
    """

    name: str
    tables: Sequence[Table]
    other_cores: float
    seconds: float = 0.0
    failure: str = ""
    earlier: str = ""


def summary(date: str, machine: Sequence[str], sections: Sequence[Section], picture: str) -> str:
    """Return the page with one table and one picture."""
    lines = ["# Benchmarks", "", f"Measured by `make bench`, {date}.", *machine[:1], "", SUMMARY]
    lines += [
        "| benchmark | armlab | fastest contender | armlab / contender | targets met |",
        "|---|---|---|---|---|",
    ]
    lines += [_summary_row(section) for section in sections if section.tables]
    lines += ["", f"![Time of armlab relative to each peer, and measurements relative to their targets]({picture})"]
    return "\n".join(lines) + "\n"


def _summary_row(section: Section) -> str:
    table = section.tables[0]
    ours = next((figure for figure in table.figures if figure.role == "armlab"), table.figures[0])
    peers = [figure for figure in table.figures if figure.role == "peer" and math.isfinite(figure.ratio)]
    best = max(peers, key=lambda figure: figure.ratio, default=None)  # largest ratio: the fastest contender
    judged = [figure.is_met for one in section.tables for figure in one.figures if figure.bar is not None]
    other, ratio = (best.name, _digits(best.ratio)) if best else ("", "")
    met = f"{sum(map(bool, judged))} of {len(judged)}" if judged else ""
    return f"| {table.title} | {_digits(ours.median * SCALE[table.unit])} {table.unit} | {other} | {ratio} | {met} |"


def render(
    date: str,
    machine: Sequence[str],
    sections: Sequence[Section],
    quick: bool = False,
    picture: str = "",
    compared: Sequence[str] = (),
) -> str:
    """Return the report with all measurements.

    Parameters
    ----------
    date : date as text. machine : sentences. quick : whether to state that the run was too short for conclusions.
    picture : file name of the picture, in the folder of the report. compared : lines about the baseline.
    """
    lines = ["# Benchmarks: all measurements", "", f"Measured by `make bench`, {date}.", *machine, ""]
    if picture:
        lines += [f"![Time of armlab relative to each peer, and measurements relative to their targets]({picture})", ""]
    if quick:
        lines += ["**A quick run gives only a first impression.**", ""]
    others = max((section.other_cores for section in sections), default=0.0)
    if others > SHARED:
        lines += [
            f"**The machine was shared:** other processes used up to {others:.1f} cores, so times (especially tails) "
            "are longer and more scattered than on an idle machine. Each table states the load during its measurement.",
            "",
        ]
    lines += [f"**{section.name} failed:** {section.failure}\n" for section in sections if section.failure]
    lines += [f"**{section.name} failed at first:** {section.earlier}\n" for section in sections if section.earlier]
    lines += [METHOD, *_bars(sections), *compared]
    for section in sections:
        for table in section.tables:
            lines += _table(table, section)
    return "\n".join([*lines, *_times(sections)]).rstrip() + "\n"


def _times(sections: Sequence[Section]) -> list[str]:
    """Return the wall-clock time of each benchmark, and the load from other processes during it."""
    total = sum(section.seconds for section in sections)
    rows = [f"| {section.name} | {section.seconds:.0f} | {section.other_cores:.2f} |" for section in sections]
    head = ["| benchmark | s | cores used by other processes |", "|---|---|---|"]
    return ["## Duration", "", f"{total / 60.0:.0f} minutes in total.", "", *head, *rows, ""]


def _bars(sections: Sequence[Section]) -> list[str]:
    judged = [(t, f) for section in sections for t in section.tables for f in t.figures if f.bar is not None]
    if not judged:
        return []
    reasons = tomllib.loads(REASONS.read_text(encoding="utf-8"))
    lines = ["## Targets", "", "| benchmark | contender | measured | target | result |", "|---|---|---|---|---|"]
    for table, figure in judged:
        if figure.over:
            measured, bar = f"{_digits(figure.multiple)} of {figure.over}", f"{figure.bar:.3g}"
        elif figure.role == "armlab":
            scale = SCALE[table.unit]
            measured, bar = (
                f"{_digits(figure.median * scale)} {table.unit}",
                f"{_digits(figure.bar * scale)} {table.unit}",
            )
        else:
            measured, bar = _ratio(figure), f"{figure.bar:.3g}"
        reason = reasons.get(table.title, {}).get(figure.name, "reason unknown")
        verdict = "met" if figure.is_met else f"**missed**: {reason}"
        lines.append(f"| {table.title} | {figure.name} | {measured} | {bar} | {verdict} |")
    return [*lines, ""]


def _table(table: Table, section: Section) -> list[str]:
    noise = f"{table.rounds} rounds; other processes used {section.other_cores:.2f} cores on average."
    head = f"| | median [{table.unit}] | minimum | quartiles | armlab / contender | |"
    rows = [_row(figure, SCALE[table.unit]) for figure in table.figures]
    return [f"## {table.title}", "", table.text, "", head, "|---|---|---|---|---|---|", *rows, "", noise, ""]


def _row(figure: Figure, scale: float) -> str:
    median, minimum, lower, upper = (
        _digits(value * scale) for value in (figure.median, figure.minimum, figure.lower, figure.upper)
    )
    name = f"**{figure.name}**" if figure.role == "armlab" else figure.name
    note = figure.note
    if figure.role == "limit":
        name = f"*{figure.name}*"
        reached = f"armlab reaches {100 / figure.ratio:.0f} % of this limit" if math.isfinite(figure.ratio) else ""
        note = "; ".join(filter(None, (note, reached)))
    return f"| {name} | {median} | {minimum} | {lower}–{upper} | {_ratio(figure)} | {note} |"


def _ratio(figure: Figure) -> str:
    if not math.isfinite(figure.ratio):  # neither side missed messages
        return "–"
    return f"{_digits(figure.ratio)} ({_digits(figure.ratio_lower)}–{_digits(figure.ratio_upper)})"


def _digits(value: float) -> str:
    """Format with three digits, without an exponent for values above 1."""
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"
