"""Comparison of a run with the stored baseline: `baseline.json`, written by `--publish`.

Times from two machines are not compared. The comparison uses ratios of armlab's time to a peer's time in the same run,
because they are nearly the same on both machines. A benchmark without a peer is compared by its own figures: times only
on the same processor, values in other units (such as errors in N) on any processor.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from blocks import TIMES, Figure
from report import Section

PATH = Path(__file__).with_name("baseline.json")
OF_THE_PROCESSOR = (*TIMES, "%")  # units that depend on the processor: times, shares of time or of rows
LEAST = 1.1  # factor on times: smaller changes are noise, regardless of the quartiles
ONCE = 1.5  # the same factor for single measurements, which have no quartiles


class Change(NamedTuple):
    """A new and a stored figure, both with quartiles, and their ratio."""

    table: str
    contender: str
    kind: str  # "ratio", "time" or "value"
    before: tuple[float, float, float]
    now: tuple[float, float, float]

    @property
    def times(self) -> float:
        """New value over old value; above 1, armlab has become slower or less accurate."""
        return self.now[0] / self.before[0]

    @property
    def is_clear(self) -> bool:
        """Whether the quartile ranges are disjoint and the change exceeds the noise level."""
        apart = self.now[1] > self.before[2] or self.now[2] < self.before[1]
        least = ONCE if any(one[1] == one[2] for one in (self.before, self.now)) else LEAST
        return apart and not 1 / least <= self.times <= least


class Comparison(NamedTuple):
    """Comparison of a run with the baseline."""

    date: str
    machine: str
    changes: Sequence[Change]
    gone: Sequence[str]
    new: Sequence[str]


def store(date: str, machine: str, sections: Sequence[Section]) -> None:
    """Store the figures of a complete run as the baseline."""
    kept = {f"{table}: {name}": {kind: list(value)} for table, name, kind, value in _values(sections)}
    text = json.dumps({"date": date, "machine": machine, "figures": kept}, indent=1, ensure_ascii=False)
    PATH.write_text(text + "\n", encoding="utf-8")


def compare(machine: str, sections: Sequence[Section], whole: bool) -> Comparison | None:
    """Return the comparison of a run with the baseline, or None if there is no baseline.

    `machine` is the line of `machine.describe` that names the processor. `whole` means that all benchmarks ran, so
    baseline figures without a counterpart are reported as missing.
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
        f"Baseline: {comparison.date}, {comparison.machine} {len(changes)} common figures; {len(clear)} differ by "
        f"more than 10 % with disjoint quartiles (by 50 % if measured once), {sum(one.times > 1 for one in clear)} "
        "of them for the worse. The comparison uses ratios (armlab's time / the peer's time) and values other than "
        "times; times are compared only on the same processor.",
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
            lines += [f"{what}:", "", *(f"* {name}" for name in names), ""]
    return lines


def _values(sections: Sequence[Section]) -> Iterator[tuple[str, str, str, tuple[float, float, float]]]:
    """Yield the table, contender, kind and (median, quartiles) of comparable figures."""
    for section in sections:
        for table in section.tables:
            has_peer = any(figure.role == "peer" for figure in table.figures)
            for figure in table.figures:
                value = _value(figure, has_peer, "time" if table.unit in OF_THE_PROCESSOR else "value")
                if value is not None and all(math.isfinite(one) and one > 0 for one in value[1]):
                    yield table.title, figure.name, *value


def _value(figure: Figure, has_peer: bool, kind: str) -> tuple[str, tuple[float, float, float]] | None:
    if figure.role == "peer":
        return "ratio", (figure.ratio, figure.ratio_lower, figure.ratio_upper)
    if figure.role == "armlab" and not has_peer:
        return kind, (figure.median, figure.lower, figure.upper)
    return None
