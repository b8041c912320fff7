"""Picture of the report: armlab's time relative to each peer, and measurements relative to their targets."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib as mpl
from blocks import Figure
from matplotlib.axes import Axes
from report import Section

mpl.use("Agg")

import matplotlib.pyplot as plt

GOOD, BAD, LINE = "#0a7f5a", "#b3341f", "#4a5a6a"
ROW = 0.2  # inches


class Dot(NamedTuple):
    """Dot of one figure: name, value with quartiles, and whether it meets its target."""

    name: str
    value: float
    lower: float
    upper: float
    good: bool


def draw(head: str, sections: Sequence[Section], path: Path) -> bool:
    """Write the picture; return whether there was anything to draw.

    Parameters
    ----------
    head : date and machine. sections : results. path : PNG file.
    """
    panels = {
        "armlab's time / the peer's time, one dot per contender": _rows(sections, _over_peer),
        "measured, relative to the project's own target": _rows(sections, _over_bar),
    }
    panels = {title: rows for title, rows in panels.items() if rows}
    if not panels:
        return False
    heights = [ROW * len(rows) + 0.9 for rows in panels.values()]
    figure, axes = plt.subplots(
        len(panels), figsize=(10.0, sum(heights) + 0.5), height_ratios=heights, squeeze=False, layout="constrained"
    )
    figure.suptitle(head, fontsize=8)
    for one, (title, rows) in zip(axes[:, 0], panels.items(), strict=True):
        _panel(one, rows, title)
    figure.savefig(path, dpi=100)
    plt.close(figure)
    return True


def _panel(axes: Axes, rows: Mapping[str, Sequence[Dot]], title: str) -> None:
    for row, dots in enumerate(rows.values()):
        for dot in dots:
            colour = GOOD if dot.good else BAD
            axes.plot([dot.lower, dot.upper], [row, row], color=colour, linewidth=1.2)
            axes.plot(dot.value, row, "o", color=colour, markersize=4.0, alpha=0.8)
        bad = [dot for dot in dots if not dot.good]
        if bad:
            worst = max(bad, key=lambda dot: dot.upper)
            name = f"  {worst.name}" + (f" and {len(bad) - 1} more" if len(bad) > 1 else "")
            axes.annotate(name, (worst.upper, row), fontsize=5, va="center", color=BAD)
    dots = [dot for some in rows.values() for dot in some]
    axes.axvline(1.0, color=LINE, linewidth=0.8)
    axes.set_xscale("log")
    low, high = axes.get_xlim()
    axes.set_xlim(low, high * (high / low) ** 0.25)  # room for the names on the right
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.set_yticks(range(len(rows)), list(rows), fontsize=6.5)
    axes.set_title(f"{title}; left of 1 is better: {sum(dot.good for dot in dots)} of {len(dots)}", fontsize=8)
    axes.tick_params(axis="x", labelsize=7, top=True, labeltop=len(rows) > 40)
    axes.grid(axis="both", color="#dddddd", linewidth=0.4)
    axes.set_axisbelow(True)


def _rows(sections: Sequence[Section], dot: Callable[[Figure], Dot | None]) -> dict[str, list[Dot]]:
    """Return the dots of each table that has any; zero and infinity cannot be shown on a logarithmic scale."""
    rows: dict[str, list[Dot]] = {}
    for table in (table for section in sections for table in section.tables):
        dots = [one for figure in table.figures if (one := dot(figure)) and 0.0 < one.value < math.inf]
        if dots:
            rows[table.title] = dots
    return rows


def _over_peer(one: Figure) -> Dot | None:
    if one.role != "peer":
        return None
    return Dot(one.name, one.ratio, one.ratio_lower, one.ratio_upper, one.ratio <= 1.0)


def _over_bar(one: Figure) -> Dot | None:
    if not one.bar or one.role == "limit":  # zero missing messages have no ratio
        return None
    scale = one.multiple / one.median if one.over else 1.0
    values = (scale * one.median, scale * one.lower, scale * one.upper)
    if one.role == "peer":
        values = (one.ratio, one.ratio_lower, one.ratio_upper)
    return Dot(one.name, *(value / one.bar for value in values), bool(one.is_met))
