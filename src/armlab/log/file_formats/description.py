"""Description of a table beside its numbers (units, kinds, notes), and columns split into components and reassembled.

A CSV file keeps it beside itself, a MAT file in a variable, Parquet and rosbag2 in their metadata; HDF5 in attributes.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np

import armlab
from armlab.errors import ArmlabError, LogError
from armlab.log.column import Column
from armlab.log.file_formats.opening import origin
from armlab.log.table import Table

Key = TypeVar("Key", bound=Hashable)

_LARGEST = 2**20  # numbers in a row: each has a heading

Progress = Callable[[float, float, str], None]
"""Is called with what is done, what there is to do, and what it is."""


class _Column(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    shape: tuple[int, ...]
    unit: str
    frame: str
    kind: str
    labels: tuple[str, ...]


class Description(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What is said of a table: version of armlab, wall clock and owner of the clock, notes, source, each column."""

    armlab: str
    t0_ns: int
    clock: str
    notes: tuple[str, ...]
    source: tuple[str, ...]
    columns: dict[str, _Column]

    def __post_init__(self) -> None:
        count = sum(math.prod(max(size, 1) for size in column.shape) for column in self.columns.values())
        if count > _LARGEST or any(size < 0 for column in self.columns.values() for size in column.shape):
            raise ValueError(f"Expected columns of at most {_LARGEST} numbers in a row together, with sizes from 0")

    @classmethod
    def of(cls, table: Table) -> Description:
        """Return the description of a table."""
        return cls(
            armlab.__version__, int(table.t0_ns), table.clock, table.notes, table.source, _columns(table.columns)
        )

    @classmethod
    def made(cls, columns: Mapping[str, Column], **about: Any) -> Description:
        """Return the description with these columns and everything else by name."""
        return cls(columns=_columns(columns), **about)

    def selected(self, names: Collection[str]) -> Description:
        """Return the description of some of the columns, in the same order."""
        kept = {name: column for name, column in self.columns.items() if name in names}
        return msgspec.structs.replace(self, columns=kept)

    def described(self) -> dict[str, Column]:
        """Return the columns in order."""
        return {name: Column(**msgspec.structs.asdict(one)) for name, one in self.columns.items()}

    def labels(self) -> list[str]:
        """Return the heading of each component, that of the clock first."""
        return ["t [s]", *(label for name, column in self.described().items() for label in headings(name, column))]

    def json(self, **more: object) -> str:
        """Return it as a text in ASCII, with `more` beside it; `of_json` reads it."""
        return json.dumps({**msgspec.to_builtins(self), **more})

    def table(self, path: Path, t: np.ndarray, values: Mapping[str, np.ndarray]) -> Table:
        """Return the table that was written to a file.

        `t`: (N,); `values`: all columns or some, of any shape with as many values. Nobody else may hold these arrays:
        the table takes them without a copy.
        """
        described = self.described()
        try:
            whole = {
                name: _stored(array, described[name].kind or "real").reshape(len(t), *described[name].shape)
                for name, array in values.items()
            }
            t.flags.writeable = False
            return Table(
                t,
                whole,
                {name: described[name] for name in whole},
                t0_ns=self.t0_ns,
                clock=self.clock,
                notes=self.notes,
                source=(origin(path), *self.source),
            )
        except (ArmlabError, ValueError, TypeError, OverflowError) as error:
            raise LogError(
                f"Expected the columns that are described in {path}, got others: {str(error).rstrip('.')}."
            ) from None


def _columns(columns: Mapping[str, Column]) -> dict[str, _Column]:
    return {
        name: _Column(one.shape, one.unit or "1", one.frame or "", one.kind or "real", one.labels)
        for name, one in columns.items()
    }


def of_json(text: str | bytes, path: Path) -> Description:
    """Return the description in a text of `Description.json`."""
    try:
        entries = json.loads(text)
        known = {name: entries[name] for name in Description.__struct_fields__ if name in entries}
        return msgspec.convert(known, Description)
    except (ValueError, TypeError, RecursionError, msgspec.ValidationError) as error:
        raise LogError(
            f"Expected a description of the columns in {path}, got: {str(error).rstrip('.')}. Export the log again."
        ) from None


def headings(name: str, column: Column) -> Sequence[str]:
    """Return the heading of each component of a column: "q2 [rad]", "wrench_hat_cov1_4 [N^2 m]"."""
    return [replace(column, unit=unit).heading(label) for label, unit in _parts(name, column)]


def components(table: Table) -> Iterator[tuple[str, str, np.ndarray]]:
    """Yield label, unit and values (N,) of each component of each column, that of the clock first."""
    yield "t", "s", table.t
    for name in table.names:
        array = table[name]
        flat = array.reshape(len(array), int(np.prod(array.shape[1:], dtype=int)))
        parts = _parts(name, table.columns[name])
        for place, (label, unit) in enumerate(parts):
            yield label, unit, flat[:, place]


def put_together(about: Description, parts: Sequence[np.ndarray], rows: int) -> dict[str, np.ndarray]:
    """Return columns (N, k) from their components in the order of `components`, without the clock's."""
    values, at = {}, 0
    for name, column in about.columns.items():
        size = int(np.prod(column.shape, dtype=int))
        values[name] = np.stack(parts[at : at + size], axis=1) if size else np.zeros((rows, 0))
        at += size
    return values


def distinct(wanted: Mapping[Key, str], taken: Iterable[str] = ()) -> dict[Key, str]:
    """Return names of which none comes twice or is taken: the later of equal ones have "_2", "_3", ... behind them.

    `wanted`: key -> name; keys that are their own names come first; `taken`: names that none may have.
    """
    used, found = set(taken), {}
    for key in sorted(wanted, key=lambda key: wanted[key] != key):
        free, number = wanted[key], 1
        while free in used:
            number += 1
            free = f"{wanted[key]}_{number}"
        used.add(free)
        found[key] = free
    return {key: found[key] for key in wanted}


def _parts(name: str, column: Column) -> Iterator[tuple[str, str]]:
    """Yield label and unit of each component; of a unit with several, forces first, then moments."""
    units = (column.unit or "1").split(", ")
    for place in np.ndindex(column.shape):
        unit = units[min(sum(index >= 3 for index in place), len(units) - 1)] if len(units) > 1 else units[0]
        yield name + "_".join(str(index + 1) for index in place), unit


def _stored(array: np.ndarray, kind: str) -> np.ndarray:
    """Return values in the type of their kind; what does not fit is refused by the table."""
    if kind == "text":
        array = array.astype(np.str_)
    if kind == "flag" and array.dtype.kind in "iu":
        array = array.astype(bool)
    array.flags.writeable = False
    return array
