"""The stored figures that a run is compared with: `baseline.json`, written by `--publish`.

Times of two machines are not compared: a ratio of armlab's time to that of a peer, measured in one run, nearly is the
same on both, so ratios are. A benchmark without a peer is compared by its own figures: times on the same processor
only, values of another unit, such as errors in N, on any.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from blocks import Figure
from report import Section

PATH = Path(__file__).with_name("baseline.json")
TIMES = ("µs", "ms", "s", "%")  # units of what the processor decides; a share is one of its time, or of its rows
LEAST = 1.1  # times: smaller changes are noise, whatever the quartiles say
ONCE = 1.5  # the same of what was measured once, which has no quartiles


class Change(NamedTuple):
    """One figure beside the stored one: both values with their quartiles, and how many times larger it has become."""

    table: str
    contender: str
    kind: str  # "ratio", "time" or "value"
    before: tuple[float, float, float]
    now: tuple[float, float, float]

    @property
    def times(self) -> float:
        """Now over before: above 1 armlab has become slower, or its error larger."""
        return self.now[0] / self.before[0]

    @property
    def is_clear(self) -> bool:
        """Whether the ranges of quartiles lie apart and the change is more than noise."""
        apart = self.now[1] > self.before[2] or self.now[2] < self.before[1]
        least = ONCE if any(one[1] == one[2] for one in (self.before, self.now)) else LEAST
        return apart and not 1 / least <= self.times <= least


class Comparison(NamedTuple):
    """A run beside the baseline: its machine line and date, what both have, and what only one has, by name."""

    date: str
    machine: str
    changes: Sequence[Change]
    gone: Sequence[str]
    new: Sequence[str]


def store(date: str, machine: str, sections: Sequence[Section]) -> None:
    """Keep the figures of a whole run as the baseline."""
    kept = {f"{table}: {name}": {kind: list(value)} for table, name, kind, value in _values(sections)}
    text = json.dumps({"date": date, "machine": machine, "figures": kept}, indent=1, ensure_ascii=False)
    PATH.write_text(text + "\n", encoding="utf-8")


def compare(machine: str, sections: Sequence[Section], whole: bool) -> Comparison | None:
    """Return a run beside the baseline, None when there is none.

    Parameters
    ----------
    machine : the line of `machine.describe` that names the processor. whole : all benchmarks ran, so that a figure of
        the baseline without its like is gone.
    """
    if not PATH.exists():
        return None
    stored = json.loads(PATH.read_text(encoding="utf-8"))
    left, changes, new = dict(stored["figures"]), [], []
    for table, name, kind, value in _values(sections):
        before = left.pop(f"{table}: {name}", {}).get(kind)
        if before is None:
            new.append(f"{table}: {name}")
        elif kind != "time" or stored["machine"] == machine:
            changes.append(Change(table, name, kind, tuple(before), value))
    return Comparison(stored["date"], stored["machine"], changes, list(left) if whole else [], new)


def render(comparison: Comparison | None) -> list[str]:
    """Return the lines of the report."""
    if comparison is None:
        return []
    changes = comparison.changes
    clear = sorted((one for one in changes if one.is_clear), key=lambda one: -one.times)
    lines = [
        "## Compared with the baseline",
        "",
        f"Baseline: {comparison.date}, {comparison.machine} {len(changes)} figures are in both; {len(clear)} differ by "
        f"more than a tenth with quartiles apart (by half, where it was measured once), "
        f"{sum(one.times > 1 for one in clear)} of them for the worse. Ratios are compared, armlab's time over the "
        "peer's, and values that are no times; times only on the same processor.",
        "",
    ]
    if clear:
        lines += ["| benchmark | contender | | baseline | now | times |", "|---|---|---|---|---|---|"]
        lines += [
            f"| {one.table} | {one.contender} | {one.kind} | {one.before[0]:.3g} | {one.now[0]:.3g} | {one.times:.2f} |"
            for one in clear
        ]
        lines.append("")
    for what, names in (("Not in the baseline", comparison.new), ("Only in the baseline", comparison.gone)):
        if names:
            lines += [f"{what}: {'; '.join(names)}.", ""]
    return lines


def _values(sections: Sequence[Section]) -> Iterator[tuple[str, str, str, tuple[float, float, float]]]:
    """Yield table, contender, kind and (median, quartiles) of what can be compared."""
    for section in sections:
        for table in section.tables:
            has_peer = any(figure.role == "peer" for figure in table.figures)
            for figure in table.figures:
                value = _value(figure, has_peer, "time" if table.unit in TIMES else "value")
                if value is not None and all(math.isfinite(one) and one > 0 for one in value[1]):
                    yield table.title, figure.name, *value


def _value(figure: Figure, has_peer: bool, kind: str) -> tuple[str, tuple[float, float, float]] | None:
    if figure.role == "peer":
        return "ratio", (figure.ratio, figure.ratio_lower, figure.ratio_upper)
    if figure.role == "armlab" and not has_peer:
        return kind, (figure.median, figure.lower, figure.upper)
    return None
