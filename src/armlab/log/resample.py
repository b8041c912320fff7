"""Tables on other clocks: resampling, joining, and putting one after another."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from armlab.errors import ShapeError, UnknownName
from armlab.lie import quaternion, se3, so3
from armlab.log.column import Column

if TYPE_CHECKING:
    from armlab.log.table import Table

__all__ = ["concat", "join", "resample"]

_HELD = ("count", "flag", "text")
_MOST_ROWS, _MOST_FOR_ONE = 10_000_000, 1000  # more than both is a slip of the rate, or of the unit of t
_SLOWER = 1.05  # periods may differ that much before resampling counts as going down in rate


def resample(table: Table, to: float | np.ndarray, *, max_gap: float | None = None) -> Table:
    """Return the table at other times: real and angle linear, pose and quaternion geodesic, count, flag and text held.

    ``x(t) = (1 - s) x_i + s x_{i+1}`` with ``s = (t - t_i) / (t_{i+1} - t_i)``; a time that exists keeps its values.

    Parameters
    ----------
    table : what to resample.
    to : rate [Hz], or increasing times (M,) [s] inside the table.
    max_gap : a longer gap between rows [s] is not bridged, NaN there; three median periods when None.

    Raises
    ------
    ShapeError : the rate goes down (that needs a filter) or up beyond all sense, a time lies outside the table, fewer
        than two rows.
    """
    if len(table) < 2:
        raise ShapeError(f"Expected at least two rows to resample, got {len(table)}.")
    period = float(np.median(np.diff(table.t)))
    t = _times(table, to)
    if len(t) > 1 and np.median(np.diff(t)) > _SLOWER * period:
        raise ShapeError(
            f"Expected a rate of at least {1 / period:.6g} Hz, got {1 / np.median(np.diff(t)):.6g} Hz: going down in "
            "rate folds noise into the signal; filter first, with signals.lowpass_offline, then take rows."
        )
    values = _at(table, t, "linear", 3.0 * period if max_gap is None else max_gap)
    values.pop("dt", None)  # the period of the old clock
    columns = {name: table.columns[name] for name in values}
    operation = f"resample({len(t)} rows, {t[0]:g} to {t[-1]:g} s)"
    return replace(table, t=t, values=values, columns=columns, source=(*table.source, operation))


def join(table: Table, other: Table, *, fill: str = "hold", max_age: float | None = None) -> Table:
    """Return a table with the columns of another brought to its clock, and the age of each as ``<name>_age``.

    Both clocks are placed on the wall clock when both tables know theirs (`t0_ns`).

    Parameters
    ----------
    table : gives the rows.
    other : gives the columns; names that both have are refused.
    fill : "hold" takes the last row at or before; "linear" interpolates as `resample` does.
    max_age : an older value is missing; any age is taken when None. With "linear", the longest gap bridged.

    Raises
    ------
    ShapeError : a column, or its age, exists in both.
    UnknownName : another way of filling.
    """
    if fill not in ("hold", "linear"):
        raise UnknownName.among("way of filling", fill, ("hold", "linear"))
    double = [name for name in other.names if name in table or f"{name}_age" in table]
    if double:
        raise ShapeError(f"Expected columns that are only in one table, got {', '.join(double)} in both; use rename.")
    offset = (table.t0_ns - other.t0_ns) / 1e9 if table.t0_ns and other.t0_ns else 0.0
    t = table.t + offset
    inside = (t >= other.t[0]) & (t <= (np.inf if fill == "hold" else other.t[-1])) if len(other) else t < -np.inf
    limit = np.inf if max_age is None else max_age
    last = np.searchsorted(other.t, t[inside], side="right") - 1
    held_age = t[inside] - other.t[last]
    late = held_age > limit
    found = _at(other, t[inside], fill, limit)
    values, columns = dict(table.values), dict(table.columns)
    age = np.full(len(table), np.nan)
    age[inside] = held_age
    for name, column in other.columns.items():
        held = fill == "hold" or column.kind in _HELD
        values[name] = _spread(_holes(found[name], late) if held else found[name], inside)
        values[f"{name}_age"] = age
        columns |= {name: column, f"{name}_age": Column(unit="s")}
    source = (*table.source, f"join({', '.join(other.names)}; {fill})", *other.source)
    return replace(table, values=values, columns=columns, source=source)


def concat(*tables: Table) -> Table:
    """Return the rows of several tables one after another on one clock; the gaps between them stay.

    Later tables are placed by the wall clock when all know theirs (`t0_ns`), else by their own t.

    Raises
    ------
    ShapeError : no table; columns, units or kinds differ; a table begins before the one before it has ended.
    """
    if not tables:
        raise ShapeError("Expected at least one table to put together, got none.")
    first = tables[0]
    for number, table in enumerate(tables[1:], 2):
        differ = sorted(set(first.names) ^ set(table.names))
        differ += [
            name for name in first.names if name in table and not _alike(first.columns[name], table.columns[name])
        ]
        if differ:
            raise ShapeError(
                f"Expected the same columns in all tables, got table {number} to differ in {', '.join(differ)}."
            )
    walled = all(table.t0_ns for table in tables)
    clocks = [table.t + ((table.t0_ns - first.t0_ns) / 1e9 if walled else 0.0) for table in tables]
    for number in range(1, len(tables)):
        before, after = clocks[number - 1], clocks[number]
        if len(before) and len(after) and after[0] <= before[-1]:
            raise ShapeError(
                f"Expected table {number + 1} to begin after {before[-1]:.6g} s, got {after[0]:.6g} s; use shifted(dt)."
            )
    return replace(
        first,
        t=np.concatenate(clocks),
        values={name: np.concatenate([table[name] for table in tables]) for name in first.names},
        notes=tuple(dict.fromkeys(note for table in tables for note in table.notes)),
        source=(*(line for table in tables for line in table.source), f"concat({len(tables)} tables)"),
    )


def _alike(a: Column, b: Column) -> bool:
    return (a.unit, a.frame, a.kind, a.shape) == (b.unit, b.frame, b.kind, b.shape)


def _times(table: Table, to: float | np.ndarray) -> np.ndarray:
    if np.ndim(to) == 0:
        rate = float(np.asarray(to))
        if not rate > 0.0 or not np.isfinite(rate):
            raise ShapeError(f"Expected a rate above zero in hertz, got {rate}.")
        span = table.t[-1] - table.t[0]
        steps = np.floor(span * rate * (1 + 1e-12) + 1e-9)
        if steps > max(_MOST_ROWS, _MOST_FOR_ONE * len(table)):
            raise ShapeError(
                f"Expected a rate that makes at most {_MOST_FOR_ONE} rows of one, got {rate:g} Hz over {span:g} s: "
                f"{steps:.3g} rows of {len(table)}. Give the rate in hertz, and t in seconds."
            )
        rows = int(steps) + 1
        return np.minimum(table.t[0] + np.arange(rows) / rate, table.t[-1])
    t = np.asarray(to, dtype=float)
    outside = np.flatnonzero(~((t >= table.t[0]) & (t <= table.t[-1])))
    if len(outside) or not len(t):
        got = f"{t[outside[0]]:g} s in row {outside[0]}" if len(outside) else "none"
        raise ShapeError(f"Expected times between {table.t[0]:g} and {table.t[-1]:g} s, got {got}: no extrapolation.")
    return t


def _at(table: Table, t: np.ndarray, fill: str, max_gap: float) -> dict[str, np.ndarray]:
    """Return the values of all columns at times inside the table."""
    left = np.searchsorted(table.t, t, side="right") - 1
    right = np.minimum(left + 1, len(table) - 1)
    gap = table.t[right] - table.t[left]
    s = np.divide(t - table.t[left], gap, out=np.zeros_like(t), where=gap > 0)
    bridged = (gap <= max_gap * (1 + 1e-9)) | (s == 0)
    values = {}
    for name in table.names:
        kind = table.columns[name].kind or "real"
        if fill == "hold" or kind in _HELD:
            values[name] = table[name][left] if fill == "hold" else _holes(table[name][left], ~bridged)
        else:
            between = _between(kind, table[name][left], table[name][right], s)
            between[~bridged] = np.nan
            values[name] = between
    return values


def _between(kind: str, a: np.ndarray, b: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Interpolate rows a and b at s (k,); where s is zero a is kept as it is, also next to a missing b."""
    weight = s.reshape(-1, *[1] * (a.ndim - 1))
    exact = weight == 0
    if kind == "quaternion":
        whole = np.isfinite(a).all(axis=-1) & np.isfinite(b).all(axis=-1)
        found = np.full(a.shape, np.nan)
        found[whole] = quaternion.slerp(a[whole], b[whole], s[whole])
    elif kind == "pose":
        whole = np.isfinite(a).all(axis=(-2, -1)) & np.isfinite(b).all(axis=(-2, -1))
        found = np.full(a.shape, np.nan)
        found[whole] = _pose_between(a[whole], b[whole], s[whole])
    else:
        found = (1.0 - weight) * a + weight * b
    return np.where(exact, a, found)


def _pose_between(T_base_a: np.ndarray, T_base_b: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Turn about one axis at constant speed and move in a straight line."""
    R_a, R_b = T_base_a[:, :3, :3], T_base_b[:, :3, :3]
    turn = so3.log(R_a.swapaxes(-1, -2) @ R_b)
    p = (1.0 - s[:, None]) * T_base_a[:, :3, 3] + s[:, None] * T_base_b[:, :3, 3]
    return se3.from_rp(R_a @ so3.exp(s[:, None] * turn), p)


def _holes(values: np.ndarray, missing: np.ndarray) -> np.ndarray:
    """Return the values with the rows of a mask (k,) missing: NaN, in text empty."""
    if not missing.any():
        return values
    values = values.copy() if values.dtype.kind == "U" else values.astype(float)
    values[missing] = "" if values.dtype.kind == "U" else np.nan
    return values


def _spread(values: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Return the values in the rows that are inside, the others missing."""
    if inside.all():
        return values
    text = values.dtype.kind == "U"
    result = np.full((len(inside), *values.shape[1:]), "" if text else np.nan, dtype=values.dtype if text else float)
    result[inside] = values
    return result
