"""Columns and arrays of other programs, with labels and units of theirs, become a `Table` in SI.

Numbered labels of a name that the glossary knows are put together: q1, q2, ... are the column q (N, n). Known
units are converted; an unknown one raises an error that names it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from armlab import glossary
from armlab.errors import ArmlabError, LogError
from armlab.log.assembly import rows_in_order
from armlab.log.column import OLD_NAMES, Column
from armlab.log.file_formats.opening import origin
from armlab.log.table import Table

CLOCKS = ("t", "time")
"""Names of the clock of a file."""

UNITS = {
    "s": ("s", 1.0),
    "ms": ("s", 1e-3),
    "us": ("s", 1e-6),
    "ns": ("s", 1e-9),
    "rad": ("rad", 1.0),
    "deg": ("rad", np.pi / 180.0),
    "m": ("m", 1.0),
    "mm": ("m", 1e-3),
    "rad/s": ("rad/s", 1.0),
    "deg/s": ("rad/s", np.pi / 180.0),
    "rev/min": ("rad/s", np.pi / 30.0),
    "rpm": ("rad/s", np.pi / 30.0),
    "m/s": ("m/s", 1.0),
    "mm/s": ("m/s", 1e-3),
    "rad/s^2": ("rad/s^2", 1.0),
    "deg/s^2": ("rad/s^2", np.pi / 180.0),
    "m/s^2": ("m/s^2", 1.0),
    "N": ("N", 1.0),
    "N m": ("N m", 1.0),
    "Nm": ("N m", 1.0),
    "N*m": ("N m", 1.0),
    "mN m": ("N m", 1e-3),
    "kg": ("kg", 1.0),
    "A": ("A", 1.0),
    "mA": ("A", 1e-3),
    "V": ("V", 1.0),
    "W": ("W", 1.0),
    "degC": ("degC", 1.0),
    "Hz": ("Hz", 1.0),
    "1": ("1", 1.0),
    "": ("", 1.0),
}
HEADING = re.compile(r"^(?P<label>.*?)(?:\s+\[(?P<unit>[^\[\]]*)\]|\[(?P<tight>[^\[\]\d][^\[\]]*)\])?$")
NUMBERED = re.compile(
    r"^(?P<name>[A-Za-z]\w*?)(?:_?(?P<number>\d+(?:_\d+)*)|\[(?P<index>\d+)\])$"
)  # q1, q_1, cov1_4, q[1]


def names_of(path: Path, headings: Sequence[str]) -> list[tuple[str, str]]:
    """Return name and unit, "" for none, of each heading: "q1 [deg]" and "q1[deg]" are q1 in deg."""
    result, seen = [], set()
    for label in headings:
        found = HEADING.match(label.removeprefix("- "))
        name, unit = (found["label"], found["unit"] or found["tight"] or "") if found else (label, "")
        if not name or name in seen:
            what = f"{name!r} twice" if name else "a column without a name"
            raise LogError(f"Expected names that come once in the header of {path}, got {what}.")
        seen.add(name)
        result.append((name, unit))
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
) -> Table:
    """Return the table of columns with units of their own; rows whose time does not advance are dropped and counted.

    `arrays`: name -> values (N, ...) and unit, "" for none; t or time is the clock; `rate`: [Hz] where there is no
    clock.
    Returned: t = 0 at the first row.
    """
    values, columns = _in_si(path, arrays)
    t = _clock(path, values, columns, rate, row)
    t, in_order, dropped = rows_in_order(t, raw, row)
    kept = np.flatnonzero(in_order)[::every]
    values, columns = _together(values, columns)
    try:
        return Table(
            t[kept] - (t[kept[0]] if len(kept) else 0.0),
            {name: array[kept] for name, array in values.items()},
            columns,
            notes=(*notes, *dropped),
            source=(origin(path),),
        )
    except ArmlabError as error:
        raise LogError(f"Expected columns that fit the glossary in {path}, got others: {error}") from None


def _in_si(path: Path, arrays: Mapping[str, tuple[np.ndarray, str]]) -> tuple[dict[str, np.ndarray], dict[str, Column]]:
    """Return the columns in SI with their units ("" where the file has none)."""
    values: dict[str, np.ndarray] = {}
    columns: dict[str, Column] = {}
    for name, (array, unit) in arrays.items():
        symbol = glossary.columns().get(name)
        kept = (unit, 1.0) if unit in _glossary_units() else None
        known = kept if symbol is not None and symbol.unit == unit else UNITS.get(unit) or kept
        if known is None:
            raise LogError(
                f"Expected a unit that armlab knows for {name!r} in {path}, got {unit!r}. Known: "
                f"{', '.join(u for u in UNITS if u)}."
            )
        if array.dtype.kind == "U":
            values[name], columns[name] = array, Column(unit=known[0], kind="text")
            continue
        if name in CLOCKS and array.dtype.kind in "iu" and len(array):
            array = array.astype(np.int64) - int(array.flat[0])  # before digits are lost
        values[name] = array if known[1] == 1.0 else array * known[1]
        kind = {"i": "count", "u": "count", "b": "flag"}.get(values[name].dtype.kind)
        columns[name] = Column(unit=known[0], kind=None if symbol else kind)
    return values, columns


def _glossary_units() -> set[str]:
    return {unit for symbol in glossary.symbols().values() for unit in symbol.unit.split(", ")}


def _clock(
    path: Path,
    values: dict[str, np.ndarray],
    columns: dict[str, Column],
    rate: float | None,
    row: Callable[[int], str],
) -> np.ndarray:
    """Take the clock (N,) [s] out of the columns, or make it of the rate."""
    name = next((clock for clock in CLOCKS if clock in values), None)
    if name is None:
        if rate is None:
            raise LogError(
                f"Expected a column t [s] in {path}, got {', '.join(values)}. Give rate= for samples that are even."
            )
        return np.arange(len(next(iter(values.values()), ()))) / rate
    t, unit = values.pop(name), columns.pop(name).unit
    if t.dtype.kind == "U" or unit not in ("s", ""):
        raise LogError(f"Expected times in s, ms, us or ns in the column {name!r} of {path}, got {unit or 'words'}.")
    bad = np.flatnonzero(~np.isfinite(t))
    if len(bad):
        raise LogError(f"Expected a time in every row of {path}, got none in {row(int(bad[0]))}.")
    return t


def _together(
    values: dict[str, np.ndarray], columns: dict[str, Column]
) -> tuple[dict[str, np.ndarray], dict[str, Column]]:
    """Put q1, q2 ... into q (N, n), where the glossary knows q as an array; the others get their unit."""
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
            result[label], described[label] = array, Column(unit=unit, kind=columns[label].kind)
        elif name not in result:
            group = groups[name]
            ordered = [values[group[at]] for at in sorted(group)]
            result[name] = np.stack(ordered, axis=1).reshape(len(array), *np.max(list(group), axis=0))
            described[name] = Column(unit=_shared_unit(name, [columns[member] for member in group.values()]))
    return result, described


def _place(label: str) -> tuple[str, tuple[int, ...]]:
    """Return the name and the place of one component of an array of the glossary; an empty place for other labels."""
    found = NUMBERED.match(label)
    known = glossary.columns().get(found["name"]) if found else None
    if found is None or known is None:
        return label, ()
    place = tuple(int(digits) for digits in (found["index"] or found["number"]).split("_"))
    return found["name"], place if len(place) == known.shape.count(",") - known.shape.count(",)") else ()


def _whole(group: dict[tuple[int, ...], str]) -> bool:
    """Tell whether every place of the array is there, counted from 1."""
    most = np.max(list(group), axis=0)
    if math.prod(most.tolist()) != len(group):  # before all places of a large number are listed
        return False
    return set(group) == {tuple(k + 1 for k in at) for at in np.ndindex(*most)}


def _shared_unit(name: str, members: list[Column]) -> str | None:
    """Return the unit of components that are one column; None for that of the glossary."""
    units, known = {member.unit for member in members}, glossary.columns()[name].unit
    if units <= {"", *known.split(", ")}:
        return None
    if len(units) > 1:
        listed = ", ".join(sorted(str(unit) for unit in units))
        raise LogError(f"Expected one unit for the components of {name}, got {listed}. Convert them.")
    return units.pop()


def foreign_table(
    path: Path, arrays: Mapping[str, tuple[np.ndarray, str]], left_out: Sequence[str] = (), raw: bool = False
) -> Table:
    """Return the table of arrays by name.

    The clock is t, time or timestamp. Other arrays have as many rows, or as many columns: they are transposed. Names of
    the ancestors' logs are read as ours. What has another size is left out, and named in the notes.

    `arrays`: name -> values and unit, "" for none.
    """
    named = {OLD_NAMES.get(name, name): entry for name, entry in arrays.items()}
    clock = next((name for name in CLOCKS if name in named and _is_line(named[name][0])), None)
    if clock is None:
        have = ", ".join(f"{name} {array.shape}" for name, (array, _) in arrays.items()) or "none"
        raise LogError(
            f"Expected times t, time or timestamp in {path}, got {have}. Read the arrays by log.read_mat or h5py and "
            "make a log of them: log.Table(t, {'q': q})."
        )
    rows = named[clock][0].size
    kept, other = {}, list(left_out)
    for name, (array, unit) in named.items():
        fitting = _by_rows(array, rows)
        if fitting is None:
            other.append(f"{name} {array.shape}")
        else:
            kept[name] = (fitting, unit)
    notes = [f"left out: {', '.join(other)}"] if other else []
    return labelled_table(path, kept, notes=notes, raw=raw)


def _is_line(array: np.ndarray) -> bool:
    """Tell whether an array has one axis at most that counts."""
    return array.size == max(array.shape, default=1)


def _by_rows(array: np.ndarray, rows: int) -> np.ndarray | None:
    """Return an array with one sample per row; None where no axis has as many."""
    if array.size == rows and array.ndim <= 2 and rows in array.shape:
        return array.ravel()
    if array.ndim and len(array) == rows:
        return array
    if array.ndim > 1 and array.shape[-1] == rows:
        return np.moveaxis(array, -1, 0)
    return None
