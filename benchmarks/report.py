"""The report in Markdown: the machine, how it was measured, the bars, and a table per benchmark."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from blocks import Figure, Table

SCALE = {"µs": 1e6, "ms": 1e3, "s": 1.0, "%": 1e2, "N": 1.0}
SHARED = 0.1  # cores; above it the report warns

METHOD = """\
Contenders run side by side: in short blocks that take turns in random order, in one process, on the same data, after a
check that they compute the same. A time is the median over the blocks, with the minimum and the quartiles. The ratio is
that of medians, armlab's time over the contender's: smaller is better. Its range is the quartiles of the ratios of
blocks of one round. Times of loops, batches and imports are processor time, which leaves out waiting for a core; those
of single steps are by the clock on the wall. A bar is the largest value that the project allows itself: of that
ratio, or of armlab's own time. Bold lines are armlab's, lines in italics are limits of the machine.
"""


@dataclass(frozen=True)
class Section:
    """The tables of one benchmark, or why there are none.

    Attributes
    ----------
    other_cores : that other processes used meanwhile. seconds : by the clock on the wall.
    failure : why it failed. earlier : why it failed before it was run once more.
    """

    name: str
    tables: Sequence[Table]
    other_cores: float
    seconds: float = 0.0
    failure: str = ""
    earlier: str = ""


def render(
    date: str,
    machine: Sequence[str],
    sections: Sequence[Section],
    quick: bool = False,
    picture: str = "",
    compared: Sequence[str] = (),
) -> str:
    """Return the report.

    Parameters
    ----------
    date : as told. machine : sentences. quick : say that the run was too short to judge by.
    picture : file of the picture, beside the report. compared : lines about the baseline.
    """
    lines = ["# Benchmarks", "", f"Measured by `make bench`, {date}.", *machine, ""]
    if picture:
        lines += [f"![armlab's time over that of each peer, and what was measured over its bar]({picture})", ""]
    if quick:
        lines += ["**A quick run: good for a look, too short to judge by.**", ""]
    others = max((section.other_cores for section in sections), default=0.0)
    if others > SHARED:
        lines += [
            f"**The machine was shared:** other processes used up to {others:.1f} cores, so that times are longer and "
            "scatter more than on a quiet one, tails above all. Each table tells how much it was meanwhile.",
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
    """Return how long each benchmark took, by the clock on the wall, and how quiet the machine was meanwhile."""
    total = sum(section.seconds for section in sections)
    rows = [f"| {section.name} | {section.seconds:.0f} | {section.other_cores:.2f} |" for section in sections]
    head = ["| benchmark | s | cores used by others |", "|---|---|---|"]
    return ["## How long it took", "", f"{total / 60.0:.0f} minutes in all.", "", *head, *rows, ""]


def _bars(sections: Sequence[Section]) -> list[str]:
    judged = [(t, f) for section in sections for t in section.tables for f in t.figures if f.bar is not None]
    if not judged:
        return []
    lines = ["## Bars", "", "| benchmark | contender | measured | bar | |", "|---|---|---|---|---|"]
    for table, figure in judged:
        if figure.role == "armlab":
            scale = SCALE[table.unit]
            measured, bar = (
                f"{_digits(figure.median * scale)} {table.unit}",
                f"{_digits(figure.bar * scale)} {table.unit}",
            )
        else:
            measured, bar = _ratio(figure), f"{figure.bar:.3g}"
        verdict = "met" if figure.is_met else "**missed**"
        lines.append(f"| {table.title} | {figure.name} | {measured} | {bar} | {verdict} |")
    return [*lines, ""]


def _table(table: Table, section: Section) -> list[str]:
    noise = f"{table.rounds} rounds; other processes used {section.other_cores:.2f} cores meanwhile."
    head = f"| | median [{table.unit}] | minimum | quartiles | armlab / it | |"
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
        note = "; ".join(filter(None, (note, f"armlab at {100 / figure.ratio:.0f} % of it")))
    return f"| {name} | {median} | {minimum} | {lower}–{upper} | {_ratio(figure)} | {note} |"


def _ratio(figure: Figure) -> str:
    if not math.isfinite(figure.ratio):  # nothing was missing on either side
        return "–"
    return f"{_digits(figure.ratio)} ({_digits(figure.ratio_lower)}–{_digits(figure.ratio_upper)})"


def _digits(value: float) -> str:
    """Three digits, never an exponent above one."""
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"
