"""Tables as text: what ``print(table)`` and ``table.describe()`` show."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from armlab.log.table import Table

__all__ = ["component_names", "describe_text", "statistics", "table_text", "timing"]


def timing(table: Table) -> dict[str, float | int]:
    """Return rows, duration [s], rate [Hz], jitter [s] (standard deviation of the period) and the longest gap [s]."""
    if len(table) < 2:
        return {"rows": len(table), "duration": 0.0, "rate": float("nan"), "jitter": float("nan"), "gap": float("nan")}
    steps = np.diff(table.t)
    return {
        "rows": len(table),
        "duration": float(table.t[-1] - table.t[0]),
        "rate": float(1.0 / np.median(steps)),
        "jitter": float(steps.std()),
        "gap": float(steps.max()),
    }


def table_text(table: Table) -> str:
    """Return one line on rows, duration, rate and jitter, and one line per column with shape, unit and missing."""
    timed = timing(table)
    head = f"Table of {timed['rows']} rows"
    if timed["rows"] > 1:
        head += (
            f", {timed['duration']:.3f} s at {timed['rate']:.6g} Hz on the {table.clock} clock "
            f"(jitter {timed['jitter'] * 1e3:.3g} ms, longest gap {timed['gap'] * 1e3:.4g} ms)"
        )
    holes = table.missing()
    lines = [("column", "shape", "unit", "missing")]
    for name in table.names:
        count, first = holes.get(name, (0, ()))
        gap = f"{count} rows from row {first[0]}" if count else "-"
        lines.append((name, str(table[name].shape), table.units[name], gap))
    notes = [f"note: {note}" for note in table.notes]
    return "\n".join([head, *_aligned(lines), *notes])


def describe_text(table: Table) -> str:
    """Return one line per component with unit, minimum, maximum, mean, standard deviation and missing values."""
    lines: list[tuple[str, ...]] = [("component", "unit", "min", "max", "mean", "sigma", "missing")]
    for name in table.names:
        stats = statistics(table[name])
        for row, label in enumerate(component_names(table, name)):
            numbers = [f"{stats[key][row]:.6g}" for key in ("min", "max", "mean", "sigma")]
            lines.append((label, table.units[name], *numbers, str(int(stats["missing"][row]))))
    return "\n".join(_aligned(lines))


def statistics(array: np.ndarray) -> dict[str, np.ndarray]:
    """Return min, max, mean, sigma and missing of each component of a column (N, ...), flattened; NaN where empty."""
    flat = array.reshape(len(array), int(np.prod(array.shape[1:])))
    width = flat.shape[1]
    if flat.dtype.kind == "U":
        nothing = np.full(width, np.nan)
        missing = (flat == "").sum(axis=0).astype(float)
        return {"min": nothing, "max": nothing, "mean": nothing, "sigma": nothing, "missing": missing}
    numbers = flat.astype(float)
    there = ~np.isnan(numbers)
    count = there.sum(axis=0)
    some = np.where(count > 0, count, np.nan)
    mean = np.where(there, numbers, 0.0).sum(axis=0) / some
    spread = np.where(there, numbers - mean, 0.0)
    empty = count == 0
    low = np.where(there, numbers, np.inf).min(axis=0, initial=np.inf)
    high = np.where(there, numbers, -np.inf).max(axis=0, initial=-np.inf)
    return {
        "min": np.where(empty, np.nan, low),
        "max": np.where(empty, np.nan, high),
        "mean": mean,
        "sigma": np.sqrt((spread**2).sum(axis=0) / some),
        "missing": (len(flat) - count).astype(float),
    }


def component_names(table: Table, name: str) -> list[str]:
    """Return the name of each component of a column: ``q[1]`` or ``q[yumi_joint_1_r]``, counted from 1."""
    shape, labels = table[name].shape[1:], table.columns[name].labels
    if not shape:
        return [name]
    names = []
    for index in np.ndindex(*shape):
        pieces = [labels[index[0]] if labels else str(index[0] + 1), *(str(i + 1) for i in index[1:])]
        names.append(f"{name}[{','.join(pieces)}]")
    return names


def _aligned(lines: list[tuple[str, ...]]) -> list[str]:
    """Return rows of words as lines with aligned columns."""
    widths = [max(len(line[i]) for line in lines) for i in range(len(lines[0]))]
    return ["  ".join(word.ljust(width) for word, width in zip(line, widths, strict=True)).rstrip() for line in lines]
