"""Column descriptions in armlab files, and labels and units in files from other programs."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

import msgspec
import numpy as np

from armlab import __version__, glossary
from armlab.errors import ArmlabError, LogError
from armlab.log.assembly import rows_in_order
from armlab.log.column import OLD_NAMES, UNITS, Column, heading
from armlab.log.file_formats.column_names import Arrays, ColumnNames, fitting_presets, listed
from armlab.log.file_formats.opening import origin
from armlab.log.table import Table

Key = TypeVar("Key", bound=Hashable)

_LARGEST = 2**20  # maximum count of numbers per row; each number has a heading

Progress = Callable[[float, float, str], None]
"""Progress callback (done, total, text)."""


class _Column(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    shape: tuple[int, ...]
    unit: str
    frame: str
    kind: str
    labels: tuple[str, ...]


class Description(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Description of a table: armlab version, wall-clock time, clock, notes, source, and every column."""

    armlab: str
    t0_ns: int
    clock: str
    notes: tuple[str, ...]
    source: tuple[str, ...]
    columns: dict[str, _Column]

    def __post_init__(self) -> None:
        count = sum(math.prod(max(size, 1) for size in column.shape) for column in self.columns.values())
        if count > _LARGEST or any(size < 0 for column in self.columns.values() for size in column.shape):
            raise ValueError(f"Expected at most {_LARGEST} numbers per row in total, with sizes of at least 0")

    @classmethod
    def of(cls, table: Table) -> Description:
        return cls(__version__, int(table.t0_ns), table.clock, table.notes, table.source, _columns(table.columns))

    @classmethod
    def made(cls, columns: Mapping[str, Column], **about: Any) -> Description:
        return cls(columns=_columns(columns), **about)

    def described(self) -> dict[str, Column]:
        return {name: Column(**msgspec.structs.asdict(one)) for name, one in self.columns.items()}

    def labels(self) -> list[str]:
        """Return the heading of each component, the clock first: "t [s]", "q1 [rad]", "wrench_hat_cov1_4 [N^2 m]"."""
        parts = [(column, part) for name, column in self.described().items() for part in _parts(name, column)]
        return ["t [s]", *(heading(replace(column, unit=unit), label) for column, (label, unit) in parts)]

    def json(self, **more: object) -> str:
        """Return the description and `more` as ASCII JSON, for `of_json`."""
        return json.dumps({**msgspec.to_builtins(self), **more})

    def table(self, path: Path, t: np.ndarray, values: Mapping[str, np.ndarray]) -> Table:
        """Rebuild a table that was written to a file; the arrays (N, ...) are used without copying."""
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
                f"Expected the columns described in {path}, got invalid columns: {str(error).rstrip('.')}."
            ) from None


def _columns(columns: Mapping[str, Column]) -> dict[str, _Column]:
    return {
        name: _Column(one.shape, one.unit or "1", one.frame or "", one.kind or "real", one.labels)
        for name, one in columns.items()
    }


def of_json(text: str | bytes, path: Path) -> Description:
    """Parse the output of `Description.json`."""
    try:
        entries = json.loads(text)
        known = {name: entries[name] for name in Description.__struct_fields__ if name in entries}
        return msgspec.convert(known, Description)
    except (ValueError, TypeError, RecursionError, msgspec.ValidationError) as error:
        raise LogError(
            f"Expected a description of the columns in {path}, got: {str(error).rstrip('.')}. Export the log again."
        ) from None


def components(table: Table) -> Iterator[tuple[str, str, np.ndarray]]:
    """Yield label, unit and values (N,) of each component of each column, the clock first."""
    yield "t", "s", table.t
    for name in table.names:
        array = table[name]
        flat = array.reshape(len(array), int(np.prod(array.shape[1:], dtype=int)))
        parts = _parts(name, table.columns[name])
        for place, (label, unit) in enumerate(parts):
            yield label, unit, flat[:, place]


def put_together(about: Description, parts: Sequence[np.ndarray], rows: int) -> dict[str, np.ndarray]:
    """Join components, in the order of `components` without the clock, into columns (N, k)."""
    values, at = {}, 0
    for name, column in about.columns.items():
        size = int(np.prod(column.shape, dtype=int))
        values[name] = np.stack(parts[at : at + size], axis=1) if size else np.zeros((rows, 0))
        at += size
    return values


def distinct(wanted: Mapping[Key, str], taken: Iterable[str] = ()) -> dict[Key, str]:
    """Return unique names that are not in `taken`; duplicates get the suffix "_2", ..."""
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
    """Yield the label and unit of each component; a compound unit gives the unit of forces, then of moments."""
    units = (column.unit or "1").split(", ")
    for place in np.ndindex(column.shape):
        unit = units[min(sum(index >= 3 for index in place), len(units) - 1)] if len(units) > 1 else units[0]
        yield name + "_".join(str(index + 1) for index in place), unit


def _stored(array: np.ndarray, kind: str) -> np.ndarray:
    """Return values in the data type of their kind; the table rejects invalid values."""
    if kind == "text":
        array = array.astype(np.str_)
    if kind == "flag" and array.dtype.kind in "iu":
        array = array.astype(bool)
    array.flags.writeable = False
    return array


CLOCKS = ("t", "time")
"""Names of clock columns."""

HEADING = re.compile(r"^(?P<label>.*?)(?:\s+\[(?P<unit>[^\[\]]*)\]|\[(?P<tight>[^\[\]\d][^\[\]]*)\])?$")
NUMBERED = re.compile(
    r"^(?P<name>[A-Za-z]\w*?)(?:_?(?P<number>\d+(?:_\d+)*)|\[(?P<index>\d+)\])$"
)  # q1, q_1, cov1_4, q[1]


COMMANDS = "sent commands"  # heading in logs of older libfranka versions, after which earlier names are repeated


def names_of(path: Path, headings: Sequence[str]) -> list[tuple[str, str]]:
    """Return the name and unit ("" if missing) of each heading: "q1 [deg]" and "q1[deg]" are q1 in deg."""
    result, seen, group = [], set(), ""
    for label in headings:
        found = HEADING.match(label.removeprefix("- "))
        name, unit = (found["label"], found["unit"] or found["tight"] or "") if found else (label, "")
        name = group + name
        if not name or name in seen:
            what = f"{name!r} twice" if name else "a column without a name"
            raise LogError(f"Expected unique names in the header of {path}, got {what}.")
        seen.add(name)
        result.append((name, unit))
        if name == COMMANDS:
            group = "cmd."
    return result


def labelled_table(
    path: Path,
    arrays: Mapping[str, tuple[np.ndarray, str]],
    *,
    rate: float | None = None,
    every: int = 1,
    notes: Sequence[str] = (),
    row: Callable[[int], str] = "row {}".format,
    raw: bool = False,
    keep_start: bool = False,
    names: ColumnNames | None = None,
    joints: Mapping[str, tuple[str, ...]] = MappingProxyType({}),
) -> Table:
    """Build a table from named arrays, each with its unit.

    The clock is t or time, or is computed from the `rate` [Hz]. `names` specifies any non-standard column names;
    `joints` labels the columns. With `keep_start`, t keeps its offset in the file.
    """
    if names is not None:
        arrays, joints = names.found(path, arrays)
        notes = [*notes, *names.notes]
    filled, apart = _rows_with_values(arrays, names)
    values, columns = _in_si(path, arrays, keep_start)
    columns |= {name: replace(columns[name], labels=labels) for name, labels in joints.items() if name in columns}
    t = _clock(path, values, columns, rate, row)
    t, in_order, dropped = rows_in_order(t, raw, row)
    kept = np.flatnonzero(in_order & filled)[::every]
    values, columns = _together(values, columns)
    try:
        return Table(
            t[kept] - (t[kept[0]] if len(kept) and not keep_start else 0.0),
            {name: array[kept] for name, array in values.items()},
            columns,
            notes=(*notes, *apart, *dropped),
            source=(origin(path),),
        )
    except ArmlabError as error:
        raise LogError(f"Expected columns that match the glossary in {path}, got invalid columns: {error}") from None


def _rows_with_values(arrays: Arrays, names: ColumnNames | None) -> tuple[np.ndarray | bool, list[str]]:
    """Return the mask of rows with values in mapped columns; PlotJuggler writes one row per message."""
    mapped = [name for name in names.entries if name != "t" and name in arrays] if names else []
    numbers = [arrays[name][0] for name in mapped if arrays[name][0].dtype.kind == "f"]
    if not numbers or len(numbers) < len(mapped):
        return True, []
    filled = np.any([np.isfinite(array).reshape(len(array), -1).any(axis=1) for array in numbers], axis=0)
    empty = int(np.count_nonzero(~filled))
    if not empty or empty == len(filled):
        return True, []
    return filled, [f"{empty} rows without values of {', '.join(mapped)} are skipped"]


def _in_si(
    path: Path, arrays: Mapping[str, tuple[np.ndarray, str]], keep_start: bool = False
) -> tuple[dict[str, np.ndarray], dict[str, Column]]:
    """Return the columns in SI units and their descriptions, with the unit "" if the file states no unit."""
    values: dict[str, np.ndarray] = {}
    columns: dict[str, Column] = {}
    units = {unit for symbol in glossary.symbols().values() for unit in symbol.unit.split(", ")}
    for name, (array, unit) in arrays.items():
        symbol = glossary.columns().get(name)
        kept = (unit, 1.0) if unit in units else None
        known = kept if symbol is not None and symbol.unit == unit else UNITS.get(unit) or kept
        if known is None:
            raise LogError(
                f"Expected a supported unit for {name!r} in {path}, got {unit!r}. Known: "
                f"{', '.join(u for u in UNITS if u)}."
            )
        if array.dtype.kind == "U":
            values[name], columns[name] = array, Column(unit=known[0], kind="text")
            continue
        if name in CLOCKS and array.dtype.kind in "iu" and len(array):
            array = array.astype(np.int64) - (0 if keep_start else int(array.flat[0]))  # avoids rounding
        values[name] = array if known[1] == 1.0 else array * known[1]
        kind = {"i": "count", "u": "count", "b": "flag"}.get(values[name].dtype.kind)
        columns[name] = Column(unit=known[0], kind=None if symbol else kind)
    return values, columns


def _clock(
    path: Path, values: dict[str, np.ndarray], columns: dict[str, Column], rate: float | None, row: Callable[[int], str]
) -> np.ndarray:
    """Remove the clock (N,) [s] from the columns and return it, or compute it from the rate."""
    name = next((clock for clock in CLOCKS if clock in values), None)
    if name is None:
        if rate is None:
            advice = fitting_presets({name: (array, "") for name, array in values.items()}) or (
                "Pass rate= for evenly sampled data, or name the time column, columns='t=NAME [ms]' (--columns t=NAME)."
            )
            raise LogError(f"Expected a column t [s] in {path}, got {listed(values)}. {advice}")
        return np.arange(len(next(iter(values.values()), ()))) / rate
    t, unit = values.pop(name), columns.pop(name).unit
    if t.dtype.kind == "U" or unit not in ("s", ""):
        raise LogError(f"Expected times in s, ms, us or ns in the column {name!r} of {path}, got {unit or 'text'}.")
    bad = np.flatnonzero(~np.isfinite(t))
    if len(bad):
        raise LogError(f"Expected a time in every row of {path}, got a missing time in {row(int(bad[0]))}.")
    return t


def _together(
    values: dict[str, np.ndarray], columns: dict[str, Column]
) -> tuple[dict[str, np.ndarray], dict[str, Column]]:
    """Join q1, q2, ... into q (N, n) for arrays in the glossary; complete the units of other columns."""
    groups: dict[str, dict[tuple[int, ...], str]] = {}
    for label, array in values.items():
        name, place = _place(label)
        if place and name not in values and array.ndim == 1:
            groups.setdefault(name, {})[place] = label
    groups = {name: group for name, group in groups.items() if _whole(group)}
    members = {label: name for name, group in groups.items() for label in group.values()}
    result: dict[str, np.ndarray] = {}
    described: dict[str, Column] = {}
    for label, array in values.items():
        name = members.get(label)
        if name is None:
            unit = columns[label].unit or (None if label in glossary.columns() else "1")
            result[label], described[label] = array, replace(columns[label], unit=unit)
        elif name not in result:
            group = groups[name]
            ordered = [values[group[at]] for at in sorted(group)]
            result[name] = np.stack(ordered, axis=1).reshape(len(array), *np.max(list(group), axis=0))
            described[name] = Column(unit=_shared_unit(name, [columns[member] for member in group.values()]))
    return result, described


def _place(label: str) -> tuple[str, tuple[int, ...]]:
    """Return the name and index of one component of a glossary array; the index is empty for other labels."""
    found = NUMBERED.match(label)
    known = glossary.columns().get(found["name"]) if found else None
    if found is None or known is None:
        return label, ()
    place = tuple(int(digits) for digits in (found["index"] or found["number"]).split("_"))
    return found["name"], place if len(place) == known.shape.count(",") - known.shape.count(",)") else ()


def _whole(group: dict[tuple[int, ...], str]) -> bool:
    """Return whether all components of the array are present, with indices counted from 1."""
    most = np.max(list(group), axis=0)
    if math.prod(most.tolist()) != len(group):  # checked before listing all indices of a large array
        return False
    return set(group) == {tuple(k + 1 for k in at) for at in np.ndindex(*most)}


def _shared_unit(name: str, members: list[Column]) -> str | None:
    """Return the common unit of a column's components; None means the unit in the glossary."""
    units, known = {member.unit for member in members}, glossary.columns()[name].unit
    if units <= {"", *known.split(", ")}:
        return None
    if len(units) > 1:
        listed = ", ".join(sorted(str(unit) for unit in units))
        raise LogError(f"Expected one unit for the components of {name}, got {listed}. Convert them.")
    return units.pop()


def foreign_table(
    path: Path,
    arrays: Mapping[str, tuple[np.ndarray, str]],
    left_out: Sequence[str] = (),
    raw: bool = False,
    names: ColumnNames | None = None,
) -> Table:
    """Build a table from named arrays with units; names used by the predecessor tools are mapped to those of armlab.

    The clock is t, time or timestamp. Arrays with one sample per column are transposed; arrays of other sizes are
    skipped.
    """
    arrays, joints = (arrays, {}) if names is None else names.found(path, arrays)
    named = {OLD_NAMES.get(name, name): entry for name, entry in arrays.items()}
    clock = next((name for name in CLOCKS if name in named and _is_vector(named[name][0])), None)
    if clock is None:
        have = ", ".join(f"{name} {array.shape}" for name, (array, _) in arrays.items()) or "none"
        raise LogError(
            f"Expected times t, time or timestamp in {path}, got {have}. Read the arrays with log.read_mat or h5py "
            f"and build a table, log.Table(t, {{'q': q}}); or name the time array, columns='t=NAME' (--columns t=NAME)."
        )
    rows = named[clock][0].size
    kept, other = {}, list(left_out)
    for name, (array, unit) in named.items():
        fitting = _by_rows(array, rows)
        if fitting is None:
            other.append(f"{name} {array.shape}")
        else:
            kept[name] = (fitting, unit)
    notes = [f"skipped: {', '.join(other)}"] if other else []
    return labelled_table(path, kept, notes=[*notes, *(names.notes if names else ())], raw=raw, joints=joints)


def renamed(path: Path, table: Table, names: ColumnNames | None) -> Table:
    """Return the table with columns renamed and scaled by their factors, as specified by `names`."""
    if names is None:
        return table
    found, joints = names.found(path, {name: (table[name], table.units[name]) for name in table.names})
    found.pop("t", None)
    same = {name: table.columns[name] for name, (array, _) in found.items() if array is table.values.get(name)}
    values, columns = _in_si(path, {name: entry for name, entry in found.items() if name not in same})
    new = {
        name: replace(one, unit=one.unit or (None if name in glossary.columns() else "1"), labels=joints.get(name, ()))
        for name, one in columns.items()
    }
    try:
        whole = {name: values.get(name, entry[0]) for name, entry in found.items()}
        return replace(table, values=whole, columns=same | new, notes=(*table.notes, *names.notes))
    except ArmlabError as error:
        raise LogError(f"Expected columns that match the glossary in {path}, got invalid columns: {error}") from None


def _is_vector(array: np.ndarray) -> bool:
    """Return whether at most one axis is longer than 1."""
    return array.size == max(array.shape, default=1)


def _by_rows(array: np.ndarray, rows: int) -> np.ndarray | None:
    """Return an array with one sample per row, or None if no axis matches the number of samples."""
    if array.size == rows and array.ndim <= 2 and rows in array.shape:
        return array.ravel()
    if array.ndim and len(array) == rows:
        return array
    if array.ndim > 1 and array.shape[-1] == rows:
        return np.moveaxis(array, -1, 0)
    return None
