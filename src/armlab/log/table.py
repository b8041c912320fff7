"""`Table`: named columns with units over one clock."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from reprlib import repr as shortened
from types import MappingProxyType
from typing import Any

import numpy as np

from armlab import glossary
from armlab._numbers import numbers
from armlab.errors import ShapeError, UnknownName
from armlab.log.column import Column, frozen, stored
from armlab.log.labels import alias, natural_key
from armlab.log.states import iterate, periods
from armlab.state import State


@dataclass(frozen=True, eq=False, repr=False)
class Table:
    """Frozen table of named columns with units over one clock.

    ``table["q"]`` is the read-only array (N, n); axis 0 is time. Known names take unit, shape and kind from the
    glossary; a new name must state its unit. Missing values are NaN and stay NaN. Operations return new tables.

    Attributes
    ----------
    t : (N,) seconds, finite, strictly increasing, near 0 at the first row of a recording.
    values : name -> array (N, ...). Also reached by ``table[name]``.
    columns : name -> `Column` (shape of a row, unit, frame, labels, kind).
    t0_ns : wall clock of t = 0, int64 nanoseconds; 0 when unknown.
    clock : whose clock `t` is: robot, bridge or file.
    notes : what happened to the data: rows dropped, seconds recovered, conversions.
    source : where the data came from and each operation since.

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
            raise ShapeError(f"Expected columns of a Table by name, as {{'q': q}}, got {shortened(self.values)}.")
        unknown = sorted(set(self.columns) - set(self.values))
        if unknown:
            raise UnknownName(f"Expected descriptions of columns that have values, got {', '.join(unknown)} without.")
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
        from armlab.log.text import table_text

        return table_text(self)

    def __reduce__(self) -> tuple[Any, ...]:
        state = (self.t, dict(self.values), dict(self.columns), self.t0_ns, self.clock, self.notes, self.source)
        return Table, state

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
        """Time since the previous row (N,) [s]: the column `dt` where recorded, else differences of `t`.

        The first row has no previous one: it takes the median (NaN when it is the only row). Where rows in between
        were taken out, the difference holds.
        """
        return frozen(periods(self.t, self.values))

    @cached_property
    def sha256(self) -> str:
        """Hash of names, units, kinds, types, shapes, values and `t`: equal data hash equal from any file."""
        return table_hash(self)

    def rows(self, which: slice | np.ndarray) -> Table:
        """Return the rows of a slice (a view), a mask or an increasing index (copies)."""
        if not isinstance(which, slice):
            which = np.asarray(which)
            if which.ndim != 1 or (which.dtype == bool and len(which) != len(self)) or which.dtype.kind not in "biu":
                raise ShapeError(
                    f"Expected a slice, a mask of {len(self)} rows or an index of rows, "
                    f"got shape {which.shape} of {which.dtype}."
                )
        values = {name: array[which] for name, array in self.values.items()}
        return self._derived("rows", t=self.t[which], values=values)

    def between(self, t0: float, t1: float) -> Table:
        """Return the rows with t0 <= t < t1 (seconds), as a view; `t` is not shifted."""
        first, last = np.searchsorted(self.t, [t0, t1], side="left")
        values = {name: array[first:last] for name, array in self.values.items()}
        return self._derived(f"between({t0:g}, {t1:g})", t=self.t[first:last], values=values)

    def where(self, mask: np.ndarray | Callable[[Table], np.ndarray]) -> Table:
        """Return the rows where the mask (N,), or a function of the table that gives one, is true."""
        return self.rows(np.asarray(mask(self) if callable(mask) else mask, dtype=bool))

    def dropna(self, *names: str) -> Table:
        """Return the rows without missing values in the named columns (all columns when none is named)."""
        whole = np.ones(len(self), dtype=bool)
        for name in names or self.names:
            whole &= ~missing_rows(self[name])
        return self._derived(
            f"dropna({', '.join(names)})",
            t=self.t[whole],
            values={name: array[whole] for name, array in self.values.items()},
            notes=(*self.notes, f"dropna: {len(self) - int(whole.sum())} of {len(self)} rows removed"),
        )

    def states(self) -> Iterator[State]:
        """Yield the `State` of each row, as a controller saw it; what the table does not have stays missing."""
        return iterate(self.t, self.dt, self.values)

    def select(self, *names: str) -> Table:
        """Return the named columns only, in this order."""
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
        """Return the table with one column more, or replaced.

        Parameters
        ----------
        name : name of the column; known names need nothing else.
        values : (N, ...) array.
        unit, frame, labels, kind : as in `Column`; a new name must state its unit.

        Raises
        ------
        ShapeError : the unit contradicts the glossary or is missing; the length is not that of the table.
        """
        columns = {**self.columns, name: Column(unit=unit, frame=frame, labels=labels, kind=kind)}
        return self._derived(f"with_column({name})", values={**self.values, name: values}, columns=columns)

    def rename(self, names: Mapping[str, str]) -> Table:
        """Return the table with columns renamed, old name to new; units stay, so they must fit the new name."""
        for old in names:
            self[old]
        new = [names.get(name, name) for name in self.names]
        if len(set(new)) < len(new):
            raise ShapeError(f"Expected new names that do not meet others, got {dict(names)}.")
        return self._derived(
            f"rename({dict(names)})",
            values=dict(zip(new, self.values.values(), strict=True)),
            columns=dict(zip(new, self.columns.values(), strict=True)),
        )

    def matching(self, pattern: str) -> np.ndarray:
        """Return all numeric columns whose name matches, side by side (N, k), in natural order (2 before 10).

        Parameters
        ----------
        pattern : regular expression, searched in the names and in their aliases, where ``: . [ ]`` are ``_``.

        Raises
        ------
        UnknownName : no column matches; the message lists the closest names.
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
        """Return the table at a rate [Hz] or at given times [s]; see `armlab.log.resample.resample`."""
        from armlab.log.resample import resample

        return resample(self, to, max_gap=max_gap)

    def join(self, other: Table, *, fill: str = "hold", max_age: float | None = None) -> Table:
        """Return this table with the columns of `other` brought to its clock; see `armlab.log.resample.join`."""
        from armlab.log.resample import join

        return join(self, other, fill=fill, max_age=max_age)

    def missing(self) -> dict[str, tuple[int, tuple[int, ...]]]:
        """Return, per column with missing values, the number of rows and the first ten row numbers."""
        holes = {name: np.flatnonzero(missing_rows(array)) for name, array in self.values.items()}
        return {name: (len(rows), tuple(int(row) for row in rows[:10])) for name, rows in holes.items() if len(rows)}

    def describe(self) -> str:
        """Return minimum, maximum, mean and standard deviation of each component as text."""
        from armlab.log.text import describe_text

        return describe_text(self)

    def _with(self, values: Mapping[str, Any], operation: str) -> Table:
        return self._derived(operation, values=values, columns={name: self.columns[name] for name in values})

    def _derived(self, operation: str, **changes: Any) -> Table:
        return replace(self, source=(*self.source, operation), **changes)


def missing_rows(array: np.ndarray) -> np.ndarray:
    """Return the mask (N,) of rows with a NaN or, in text, an empty value."""
    if array.dtype.kind not in "fU" or not array.size:
        return np.zeros(len(array), dtype=bool)
    holes = np.isnan(array) if array.dtype.kind == "f" else np.asarray(array == "")
    return np.asarray(holes.reshape(len(array), -1).any(axis=1))


def _check_clock(t: np.ndarray) -> None:
    if t.ndim != 1:
        raise ShapeError(f"Expected times of shape (N,), got {t.shape}.")
    bad = np.flatnonzero(~np.isfinite(t))
    if len(bad):
        raise ShapeError(f"Expected finite times, got {t[bad[0]]} in row {bad[0]} ({len(bad)} such rows).")
    bad = np.flatnonzero(np.diff(t) <= 0)
    if len(bad):
        row = int(bad[0]) + 1
        raise ShapeError(
            f"Expected strictly increasing times, got {t[row]:.9g} s in row {row} after {t[row - 1]:.9g} s "
            f"({len(bad)} such rows); drop these rows or sort by time."
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


def table_hash(table: Table) -> str:
    """Return the SHA-256 over `t` and, by name, unit, kind, type, shape and bytes of every column.

    Notes, source and clock do not count: the same data from two formats hash equal. Every NaN counts as the same NaN.
    """
    digest = hashlib.sha256(b"armlab table 1\n")
    digest.update(_bytes(table.t))
    for name in sorted(table.names):
        column, array = table.columns[name], table[name]
        kind = "text" if array.dtype.kind == "U" else array.dtype.str
        digest.update("\0".join([name, column.unit or "1", column.kind or "", kind, str(array.shape)]).encode())
        digest.update(_bytes(array))
    return digest.hexdigest()


def _bytes(array: np.ndarray) -> bytes | memoryview:
    """Return the bytes that count: text without padding, one pattern for NaN."""
    if array.dtype.kind == "U":
        return "\0".join(array.ravel().tolist()).encode()
    if array.dtype.kind == "f" and np.isnan(array).any():
        array = np.where(np.isnan(array), np.nan, array)
    return np.ascontiguousarray(array).reshape(-1).view(np.uint8).data
