"""`Table`: time-stamped columns with units; each row can be read as a controller `State`."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from html import escape
from importlib import import_module
from reprlib import repr as shortened
from types import MappingProxyType
from typing import Any

import numpy as np

from armlab import glossary
from armlab._numbers import numbers
from armlab.errors import MissingExtra, ShapeError, UnknownName
from armlab.log.column import Column, alias, between, frozen, holes, missing_rows, natural_key, spread, stored
from armlab.state import State

# The columns `qd_source` and `tau_source` hold indices into these tuples.
QD_SOURCES = ("difference", "measured")
TAU_SOURCES = ("none", "measured", "reference")

# Optional fields of `State` in a table.
_ARRAYS = ("qdd", "q_planned", "T_frame_tool", "wrench_raw", "wrench", "q_ext", "rapid_data")
_PREVIOUS = ("q_sent", "qd_sent", "clamped")  # a row contains its own reply, but a State contains the previous reply
_NUMBERS = {"seq": int, "missed": int, "session": int, "motors": int, "rapid": int, "mci": int}
_NUMBERS |= {"utilization": float, "robot_ns": int, "converged": bool, "rapid_digital": bool}


def _states(table: Table) -> Iterator[State]:
    """Yield one `State` per row, with NaN for missing values; session time and first position are set if recorded."""
    values, q = table.values, table["q"]
    nothing = np.full(q.shape[1:], np.nan)
    nothing.flags.writeable = False
    arrays = {name: values[name] for name in _ARRAYS if name in values}
    numbers = {name: (kind, values[name].tolist()) for name, kind in _NUMBERS.items() if name in values}
    replies = {name: values[name] for name in _PREVIOUS if name in values}
    clock = values.get("session_t", table.t)
    receive = values["receive_ns"].tolist() if "receive_ns" in values else None
    qd, tau = values.get("qd"), values.get("tau")
    words = {"qd_source": QD_SOURCES, "tau_source": TAU_SOURCES}
    codes = {name: (known, values[name].tolist()) for name, known in words.items() if name in values}
    constant = {} if tau is None or "tau_source" in values else {"tau_source": "measured"}
    session, q_start = None, nothing
    for row, (t, dt) in enumerate(zip(clock.tolist(), table.dt.tolist(), strict=True)):
        extra: dict[str, Any] = {name: array[row] for name, array in arrays.items()}
        extra |= {name: array[row - 1] for name, array in replies.items() if row}
        extra |= {name: kind(column[row]) for name, (kind, column) in numbers.items() if column[row] == column[row]}
        extra |= {name: known[int(code[row])] for name, (known, code) in codes.items()} | constant
        if receive is not None and receive[row] == receive[row]:
            extra["t_receive"] = int(receive[row])
        if extra.get("session", 1) != session:
            session, q_start = extra.get("session", 1), q[row]
        yield State(
            t=t,
            dt=dt,
            q=q[row],
            qd=nothing if qd is None else qd[row],
            tau=nothing if tau is None else tau[row],
            q_start=q_start,
            **extra,
        )


@dataclass(frozen=True, eq=False, repr=False)
class Table:
    """Immutable table of named columns with units on one clock.

    ``table["q"]`` is the read-only array (N, n); axis 0 is time. Names in the glossary determine unit, shape and kind;
    other names require a unit. Missing values are NaN and remain NaN. Operations return new tables.

    Attributes
    ----------
    t : array, shape (N,), s
        Time; finite, strictly increasing, and near 0 at the first row of a recording.
    values : mapping
        Arrays (N, ...) by name; ``table[name]`` returns one array.
    columns : mapping
        `Column` by name: shape of a row, unit, frame, labels, kind.
    t0_ns : int, ns
        Wall-clock time at t = 0; 0 if unknown.
    clock : str
        Clock of `t`: robot, bridge or file.
    notes : tuple of str
        Changes to the data: rows dropped, seconds recovered, conversions.
    source : tuple of str
        Origin of the data, and all operations applied to it.

    Examples
    --------
    >>> table = Table([0.0, 0.004], {"q": [[0.1], [0.2]], "grip": [1.0, 2.0]}, {"grip": Column(unit="N")})
    >>> table.units["grip"], table.columns["q"].unit, len(table)
    ('N', 'rad', 2)
    """

    t: np.ndarray
    values: Mapping[str, np.ndarray]
    columns: Mapping[str, Column] = field(default_factory=dict)
    t0_ns: int = 0
    clock: str = "file"
    notes: tuple[str, ...] = ()
    source: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        t = frozen(numbers(self.t, "times t [s] of a Table", ShapeError))
        _check_clock(t)
        if not isinstance(self.values, Mapping):
            raise ShapeError(f"Expected columns of a Table by name, such as {{'q': q}}, got {shortened(self.values)}.")
        unknown = sorted(set(self.columns) - set(self.values))
        if unknown:
            raise UnknownName(
                f"Expected descriptions only for columns with values, got descriptions of {', '.join(unknown)}."
            )
        kept = {name: stored(name, values, self.columns.get(name)) for name, values in self.values.items()}
        _check_lengths(len(t), {name: entry[0] for name, entry in kept.items()})
        notes = [entry[2] for entry in kept.values() if entry[2]]
        set_field = object.__setattr__
        set_field(self, "t", t)
        set_field(self, "values", MappingProxyType({name: entry[0] for name, entry in kept.items()}))
        set_field(self, "columns", MappingProxyType({name: entry[1] for name, entry in kept.items()}))
        set_field(self, "notes", (*self.notes, *(note for note in notes if note not in self.notes)))
        set_field(self, "source", tuple(self.source))

    def __len__(self) -> int:
        return len(self.t)

    def __contains__(self, name: object) -> bool:
        return name in self.values

    def __getitem__(self, name: str) -> np.ndarray:
        if name == "t":
            return self.t
        try:
            return self.values[name]
        except KeyError:
            raise UnknownName.among("column", name, self.values) from None

    def __repr__(self) -> str:
        return f"<Table {len(self)} rows: {', '.join(self.names)}>"

    def __str__(self) -> str:
        """Return rows, duration, rate and jitter, then shape, unit and missing rows of each column."""
        timed = timing(self)
        head = f"Table of {timed['rows']} rows"
        if timed["rows"] > 1:
            head += (
                f", {timed['duration']:.3f} s at {timed['rate']:.6g} Hz on the {self.clock} clock "
                f"(jitter {timed['jitter'] * 1e3:.3g} ms, longest gap {timed['gap'] * 1e3:.4g} ms)"
            )
        holes = self.missing()
        lines = [("column", "shape", "unit", "missing")]
        for name in self.names:
            count, first = holes.get(name, (0, ()))
            gap = f"{count} rows from row {first[0]}" if count else "-"
            lines.append((name, str(self[name].shape), self.units[name], gap))
        return "\n".join([head, *_aligned(lines), *(f"note: {note}" for note in self.notes)])

    def __reduce__(self) -> tuple[Any, ...]:
        return Table, (self.t, dict(self.values), dict(self.columns), self.t0_ns, self.clock, self.notes, self.source)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns in order, without `t`."""
        return tuple(self.values)

    @property
    def units(self) -> Mapping[str, str]:
        """Unit of each column."""
        return {name: column.unit or "1" for name, column in self.columns.items()}

    @cached_property
    def dt(self) -> np.ndarray:
        """Time since the previous row (N,) [s]: the column `dt` if recorded, otherwise differences of `t`.

        The first value is the median (NaN for a single row). Across removed rows, the difference of `t` is used.
        """
        steps = np.diff(self.t)
        usual = np.median(steps) if len(steps) else np.nan
        differences = np.concatenate(([usual][: len(self)], steps))
        recorded = self.values.get("dt")
        if recorded is None or not len(self):
            return frozen(differences)
        begins = np.ones(len(self), dtype=bool)  # first rows of sessions, where `dt` and the differences may disagree
        begins[1:] = np.diff(self["session"]) != 0 if "session" in self else False
        trusted = begins | (np.abs(recorded - differences) < 0.5 * usual)  # otherwise rows were removed
        return frozen(np.where(trusted & np.isfinite(recorded), recorded, differences))

    @cached_property
    def sha256(self) -> str:
        """Hash of names, units, kinds, types, shapes, values and `t`: equal data have equal hashes in any file format.

        Notes, source and clock are excluded. All NaN values count as equal.
        """
        digest = hashlib.sha256(b"armlab table 1\n")
        digest.update(_bytes(self.t))
        for name in sorted(self.names):
            column, array = self.columns[name], self[name]
            kind = "text" if array.dtype.kind == "U" else array.dtype.str
            digest.update("\0".join([name, column.unit or "1", column.kind or "", kind, str(array.shape)]).encode())
            digest.update(_bytes(array))
        return digest.hexdigest()

    def rows(self, which: slice | np.ndarray) -> Table:
        """Return the rows of a slice (a view), a mask or an increasing index (copies)."""
        if not isinstance(which, slice):
            which = np.asarray(which)
            if which.ndim != 1 or (which.dtype == bool and len(which) != len(self)) or which.dtype.kind not in "biu":
                raise ShapeError(
                    f"Expected a slice, a mask of {len(self)} rows or an index of rows, "
                    f"got an array of shape {which.shape} and type {which.dtype}."
                )
        return self._taken(which, "rows")

    def between(self, t0: float, t1: float) -> Table:
        """Return the rows with t0 <= t < t1 (seconds), as a view; `t` is not shifted."""
        return self._taken(slice(*np.searchsorted(self.t, [t0, t1], side="left")), f"between({t0:g}, {t1:g})")

    def where(self, mask: np.ndarray | Callable[[Table], np.ndarray]) -> Table:
        """Return the rows where a mask (N,) is true; `mask` may also be a function that returns the mask of a table."""
        return self.rows(np.asarray(mask(self) if callable(mask) else mask, dtype=bool))

    def dropna(self, *names: str) -> Table:
        """Return the rows without missing values in the named columns (default: all columns)."""
        whole = np.ones(len(self), dtype=bool)
        for name in names or self.names:
            whole &= ~missing_rows(self[name])
        note = f"dropna: {len(self) - int(whole.sum())} of {len(self)} rows removed"
        return self._taken(whole, f"dropna({', '.join(names)})", notes=(*self.notes, note))

    def states(self) -> Iterator[State]:
        """Yield the `State` of each row as the controller received it; absent columns remain missing."""
        if "q" not in self:
            raise UnknownName.among("column", "q", self.values)
        return _states(self)

    def select(self, *names: str) -> Table:
        """Return only the named columns, in this order."""
        return self._with({name: self[name] for name in names}, f"select({', '.join(names)})")

    def without(self, *names: str) -> Table:
        """Return the table without the named columns."""
        for name in names:
            self[name]
        keep = {name: array for name, array in self.values.items() if name not in names}
        return self._with(keep, f"without({', '.join(names)})")

    def with_column(
        self,
        name: str,
        values: Any,
        *,
        unit: str | None = None,
        frame: str | None = None,
        labels: tuple[str, ...] = (),
        kind: str | None = None,
    ) -> Table:
        """Return the table with an added or replaced column.

        Parameters
        ----------
        name : str
            Name of the column; names in the glossary need no attributes.
        values : array, shape (N, ...)
            Values.
        unit : str
            SI unit; required for a new name.
        frame : str
            See `Column`.
        labels : tuple of str
            See `Column`.
        kind : str
            See `Column`.

        Raises
        ------
        ShapeError
            The unit is missing or contradicts the glossary, or the length is wrong.
        """
        columns = {**self.columns, name: Column(unit=unit, frame=frame, labels=labels, kind=kind)}
        return self._derived(f"with_column({name})", values={**self.values, name: values}, columns=columns)

    def rename(self, names: Mapping[str, str]) -> Table:
        """Return the table with columns renamed as in `names` (old to new); the units must match the new names."""
        for old in names:
            self[old]
        new = [names.get(name, name) for name in self.names]
        if len(set(new)) < len(new):
            raise ShapeError(f"Expected new names that differ from other columns, got {dict(names)}.")
        return self._derived(
            f"rename({dict(names)})",
            values=dict(zip(new, self.values.values(), strict=True)),
            columns=dict(zip(new, self.columns.values(), strict=True)),
        )

    def matching(self, pattern: str) -> np.ndarray:
        """Return all numeric columns with a matching name, side by side (N, k), in natural order (2 before 10).

        Parameters
        ----------
        pattern : str
            Regular expression for names or aliases, in which ``_`` replaces ``: . [ ]``.

        Raises
        ------
        UnknownName
            No column matches; the message lists the closest names.
        """
        found = [name for name in self.names if re.search(pattern, name) or re.search(pattern, alias(name))]
        found = [name for name in found if self.columns[name].kind != "text"]
        if not found:
            raise UnknownName.among("column that matches", pattern, self.names)
        parts = [self[name].reshape(len(self), -1) for name in sorted(found, key=natural_key)]
        return frozen(np.concatenate(parts, axis=1))

    def shifted(self, dt: float) -> Table:
        """Return the table with `dt` seconds added to its clock."""
        return self._derived(f"shifted({dt:g})", t=self.t + dt)

    def resample(self, to: float | np.ndarray, *, max_gap: float | None = None) -> Table:
        """Resample the table: numbers linearly, poses and quaternions geodesically; counts, flags and text are held.

        ``x(t) = (1 - s) x_i + s x_{i+1}``, ``s = (t - t_i) / (t_{i+1} - t_i)``; existing times keep their values.

        Parameters
        ----------
        to : float, Hz, or array, shape (M,), s
            Rate, or increasing times within the range of the table.
        max_gap : float, s
            Longest gap between rows that is interpolated; values in longer gaps are NaN. Default: three median periods.

        Raises
        ------
        ShapeError
            The rate is lower than that of the table (filter first) or implausibly high, a time is outside the table, or
            the table has fewer than two rows.
        """
        if len(self) < 2:
            raise ShapeError(f"Expected at least two rows to resample, got {len(self)}.")
        period = float(np.median(np.diff(self.t)))
        t = _times(self, to)
        if len(t) > 1 and np.median(np.diff(t)) > _SLOWER * period:
            raise ShapeError(
                f"Expected a rate of at least {1 / period:.6g} Hz, got {1 / np.median(np.diff(t)):.6g} Hz: a lower "
                "rate aliases noise into the signal. Filter first, with signals.lowpass_offline, then select rows."
            )
        values = _at(self, t, "linear", 3.0 * period if max_gap is None else max_gap)
        values.pop("dt", None)  # sample periods of the old clock
        columns = {name: self.columns[name] for name in values}
        operation = f"resample({len(t)} rows, {t[0]:g} to {t[-1]:g} s)"
        return self._derived(operation, t=t, values=values, columns=columns)

    def join(self, other: Table, *, fill: str = "hold", max_age: float | None = None) -> Table:
        """Add another table's columns at the times of this table, and the age of each value as ``<name>_age``.

        The tables are aligned by wall-clock time (`t0_ns`) if both have it, otherwise by `t`.

        Parameters
        ----------
        other : Table
            Table with the columns to add, whose names must be new.
        fill : str
            "hold" uses the last row at or before each time. "linear" interpolates as in `resample`.
        max_age : float, s
            Age beyond which a held value is missing, or the longest interpolated gap; default: unlimited.

        Raises
        ------
        ShapeError
            A column or its age exists in both tables.
        UnknownName
            `fill` is unknown.
        """
        if fill not in ("hold", "linear"):
            raise UnknownName.among("fill method", fill, ("hold", "linear"))
        double = [name for name in other.names if name in self or f"{name}_age" in self]
        if double:
            raise ShapeError(
                f"Expected columns that exist in only one table, got {', '.join(double)} in both. Use rename."
            )
        t = self.t + ((self.t0_ns - other.t0_ns) / 1e9 if self.t0_ns and other.t0_ns else 0.0)
        inside = (t >= other.t[0]) & (t <= (np.inf if fill == "hold" else other.t[-1])) if len(other) else t < -np.inf
        limit = np.inf if max_age is None else max_age
        held_age = t[inside] - other.t[np.searchsorted(other.t, t[inside], side="right") - 1]
        found = _at(other, t[inside], fill, limit)
        values, columns = dict(self.values), dict(self.columns)
        age = spread(held_age, inside)
        for name, column in other.columns.items():
            held = fill == "hold" or column.kind in _HELD
            values[name] = spread(holes(found[name], held_age > limit) if held else found[name], inside)
            values[f"{name}_age"] = age
            columns |= {name: column, f"{name}_age": Column(unit="s")}
        source = (*self.source, f"join({', '.join(other.names)}; {fill})", *other.source)
        return replace(self, values=values, columns=columns, source=source)

    def to_pandas(self) -> Any:
        """Return a pandas DataFrame indexed by t [s], with a column per component (q1, q2, ...); units are in
        ``attrs["units"]``.

        Raises
        ------
        MissingExtra : pandas is not installed.
        """
        frame = _package("pandas").DataFrame({name: one for name, _, one in self._components()}, index=self.t)
        frame.index.name = "t"
        frame.attrs["units"] = {name: unit for name, unit, _ in self._components()}
        return frame

    def to_polars(self) -> Any:
        """Return a polars DataFrame with the column t [s] and a column per component (q1, q2, ...).

        Raises
        ------
        MissingExtra : polars is not installed.
        """
        return _package("polars").DataFrame({"t": self.t, **{name: one for name, _, one in self._components()}})

    def to_arrow(self) -> Any:
        """Return a pyarrow Table with t and a column per component (q1, q2, ...); units are in the field metadata.

        Raises
        ------
        MissingExtra : pyarrow is not installed.
        """
        pa = _package("pyarrow")
        parts = [(name, unit, pa.array(values)) for name, unit, values in (("t", "s", self.t), *self._components())]
        fields = [pa.field(name, array.type, metadata={"unit": unit}) for name, unit, array in parts]
        return pa.Table.from_arrays([array for *_, array in parts], schema=pa.schema(fields))

    def to_xarray(self) -> Any:
        """Return an xarray Dataset with coordinate t [s]; columns keep their shape, with attributes units and frame.

        The dimensions of a row are named after its column; joint names become coordinates.

        Raises
        ------
        MissingExtra : xarray is not installed.
        """
        xarray, variables = _package("xarray"), {}
        coordinates: dict[str, Any] = {"t": ("t", self.t, {"units": "s"})}
        for name, column in self.columns.items():
            axes = ["t", *(f"{name}_{k}" for k in range(len(column.shape)))]
            variables[name] = (axes, self[name], {"units": column.unit or "1", "frame": column.frame or ""})
            if column.labels:
                coordinates[axes[1]] = (axes[1], list(column.labels), {})
        return xarray.Dataset(variables, coordinates)

    def _components(self) -> Iterator[tuple[str, str, np.ndarray]]:
        """Yield the name (q1, q2, ..., T_base_tool1_1), unit and values (N,) of each component."""
        units = self.units
        for name, array in self.values.items():
            for index in np.ndindex(*array.shape[1:]):
                yield name + "_".join(str(k + 1) for k in index), units[name], np.array(array[(slice(None), *index)])

    def _repr_html_(self) -> str:
        """Return the notebook view: rows, rate, and a line per column with shape, unit, missing count and range."""
        head, *lines = str(self).split("\n")
        ranges = {name: statistics(array) for name, array in self.values.items()}
        cells = []
        for name in self.names:
            low, high = np.nanmin([*ranges[name]["min"], np.inf]), np.nanmax([*ranges[name]["max"], -np.inf])
            span = f"{low:.4g} to {high:.4g}" if low <= high else "-"
            count = self.missing().get(name, (0, ()))[0]
            cells.append((name, str(self[name].shape), self.units[name], str(count or "-"), span))
        titles = "".join(f"<th>{word}</th>" for word in ("column", "shape", "unit", "missing", "range"))
        rows = "".join(f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in cells)
        notes = "".join(f"<br>{escape(line)}" for line in lines if line.startswith("note: "))
        return f"<div>{escape(head)}{notes}<table><thead><tr>{titles}</tr></thead><tbody>{rows}</tbody></table></div>"

    def missing(self) -> dict[str, tuple[int, tuple[int, ...]]]:
        """Return, for each column with missing values, the number of affected rows and the first ten of these rows."""
        holes = {name: np.flatnonzero(missing_rows(array)) for name, array in self.values.items()}
        return {name: (len(rows), tuple(int(row) for row in rows[:10])) for name, rows in holes.items() if len(rows)}

    def describe(self) -> str:
        """Return the minimum, maximum, mean and standard deviation of each component as a text table."""
        lines: list[tuple[str, ...]] = [("component", "unit", "min", "max", "mean", "sigma", "missing")]
        for name in self.names:
            stats = statistics(self[name])
            for row, label in enumerate(component_names(self, name)):
                numbers = [f"{stats[key][row]:.6g}" for key in ("min", "max", "mean", "sigma")]
                lines.append((label, self.units[name], *numbers, str(int(stats["missing"][row]))))
        return "\n".join(_aligned(lines))

    def _taken(self, rows: slice | np.ndarray, operation: str, **changes: Any) -> Table:
        values = {name: array[rows] for name, array in self.values.items()}
        return self._derived(operation, t=self.t[rows], values=values, **changes)

    def _with(self, values: Mapping[str, Any], operation: str) -> Table:
        return self._derived(operation, values=values, columns={name: self.columns[name] for name in values})

    def _derived(self, operation: str, **changes: Any) -> Table:
        return replace(self, source=(*self.source, operation), **changes)


def _package(name: str) -> Any:
    try:
        return import_module(name)
    except ImportError:
        raise MissingExtra(
            f"Expected the package {name}, but it is not installed. Install it: pip install {name}."
        ) from None


def _check_clock(t: np.ndarray) -> None:
    if t.ndim != 1:
        raise ShapeError(f"Expected times of shape (N,), got {t.shape}.")
    bad = np.flatnonzero(~np.isfinite(t))
    if len(bad):
        raise ShapeError(f"Expected finite times, got {t[bad[0]]} in row {bad[0]} ({len(bad)} rows in total).")
    bad = np.flatnonzero(np.diff(t) <= 0)
    if len(bad):
        row = int(bad[0]) + 1
        raise ShapeError(
            f"Expected strictly increasing times, got {t[row]:.9g} s in row {row} after {t[row - 1]:.9g} s "
            f"({len(bad)} rows in total). Drop these rows or sort by time."
        )


def _check_lengths(rows: int, values: Mapping[str, np.ndarray]) -> None:
    joints: dict[str, int] = {}
    for name, array in values.items():
        if len(array) != rows:
            raise ShapeError(f"Expected {rows} rows in the column {name!r}, as in t, got {len(array)}.")
        known = glossary.columns().get(name)
        if known and known.shape == "(N, n)":
            joints[name] = array.shape[1]
    if len(set(joints.values())) > 1:
        raise ShapeError(f"Expected the same number of joints in all columns, got {joints}.")


def _bytes(array: np.ndarray) -> bytes | memoryview:
    """Return the bytes to hash: text without padding, and one bit pattern for all NaN values."""
    if array.dtype.kind == "U":
        return "\0".join(array.ravel().tolist()).encode()
    if array.dtype.kind == "f" and np.isnan(array).any():
        array = np.where(np.isnan(array), np.nan, array)
    return np.ascontiguousarray(array).reshape(-1).view(np.uint8).data


_HELD = ("count", "flag", "text")
_MOST_ROWS, _MOST_FOR_ONE = 10_000_000, 1000  # if both are exceeded, the rate or the unit of t is wrong
_SLOWER = 1.05  # ratio of periods above which resampling counts as downsampling


def concat(*tables: Table) -> Table:
    """Concatenate the rows of several tables on one clock; gaps between them remain.

    If all tables have a wall-clock time (`t0_ns`), it determines the times of the later tables; otherwise, their own
    `t` does.

    Parameters
    ----------
    *tables : Table
        Tables in chronological order.

    Raises
    ------
    ShapeError
        No tables are given; columns, units or kinds differ; or a table begins before the previous table ends.
    """
    if not tables:
        raise ShapeError("Expected at least one table to concatenate, got none.")
    described = [{name: replace(one, labels=()) for name, one in table.columns.items()} for table in tables]
    first, columns = tables[0], described[0]
    for number, other in enumerate(described[1:], 2):
        differ = sorted(name for name in columns.keys() | other.keys() if columns.get(name) != other.get(name))
        if differ:
            raise ShapeError(
                f"Expected the same columns in all tables, but table {number} differs in {', '.join(differ)}."
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


def _times(table: Table, to: float | np.ndarray) -> np.ndarray:
    if np.ndim(to) == 0:
        rate = float(np.asarray(to))
        if not rate > 0.0 or not np.isfinite(rate):
            raise ShapeError(f"Expected a rate above 0 Hz, got {rate} Hz.")
        span = table.t[-1] - table.t[0]
        steps = np.floor(span * rate * (1 + 1e-12) + 1e-9)
        if steps > max(_MOST_ROWS, _MOST_FOR_ONE * len(table)):
            raise ShapeError(
                f"Expected a rate that gives at most {_MOST_FOR_ONE} rows per recorded row, got {rate:g} Hz over "
                f"{span:g} s: {steps:.3g} rows from {len(table)} rows. Pass the rate in hertz and t in seconds."
            )
        rows = int(steps) + 1
        return np.minimum(table.t[0] + np.arange(rows) / rate, table.t[-1])
    t = np.asarray(to, dtype=float)
    outside = np.flatnonzero(~((t >= table.t[0]) & (t <= table.t[-1])))
    if len(outside) or not len(t):
        got = f"{t[outside[0]]:g} s in row {outside[0]}" if len(outside) else "no times"
        raise ShapeError(
            f"Expected times between {table.t[0]:g} and {table.t[-1]:g} s, got {got}. Tables are not extrapolated."
        )
    return t


def _at(table: Table, t: np.ndarray, fill: str, max_gap: float) -> dict[str, np.ndarray]:
    """Return all columns at times within the range of the table."""
    left = np.searchsorted(table.t, t, side="right") - 1
    right = np.minimum(left + 1, len(table) - 1)
    gap = table.t[right] - table.t[left]
    s = np.divide(t - table.t[left], gap, out=np.zeros_like(t), where=gap > 0)
    bridged = (gap <= max_gap * (1 + 1e-9)) | (s == 0)
    values = {}
    for name in table.names:
        kind = table.columns[name].kind or "real"
        if fill == "hold" or kind in _HELD:
            values[name] = table[name][left] if fill == "hold" else holes(table[name][left], ~bridged)
        else:
            found = between(kind, table[name][left], table[name][right], s)
            found[~bridged] = np.nan
            values[name] = found
    return values


def timing(table: Table) -> dict[str, float | int]:
    """Return rows, duration [s], rate [Hz], jitter [s] (standard deviation of the period) and longest gap [s]."""
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


def statistics(array: np.ndarray) -> dict[str, np.ndarray]:
    """Return min, max, mean, sigma and missing of each component (flattened) of a column (N, ...); NaN if empty."""
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
    """Return the name of each component of a column, counted from 1: ``q[1]`` or ``q[yumi_joint_1_r]``."""
    shape, labels = table[name].shape[1:], table.columns[name].labels
    if not shape:
        return [name]
    names = []
    for index in np.ndindex(*shape):
        pieces = [labels[index[0]] if labels else str(index[0] + 1), *(str(i + 1) for i in index[1:])]
        names.append(f"{name}[{','.join(pieces)}]")
    return names


def _aligned(lines: list[tuple[str, ...]]) -> list[str]:
    widths = [max(len(line[i]) for line in lines) for i in range(len(lines[0]))]
    return ["  ".join(word.ljust(width) for word, width in zip(line, widths, strict=True)).rstrip() for line in lines]
