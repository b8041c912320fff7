"""`read_csv`: delimited text becomes a `Table`; units are in the header.

``t [s],q1 [rad],q2 [rad],grip [N]`` becomes the columns q (N, 2) and grip (N,): numbered labels of a name that the
glossary knows are put together. Units that are known are converted to SI; others are refused by name.
"""

from __future__ import annotations

import csv
import gzip
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from armlab import glossary
from armlab.errors import ArmlabError, LogError
from armlab.log.column import Column
from armlab.log.formats import format_of
from armlab.log.provenance import file_hash
from armlab.log.sidecar import Sidecar, read_sidecar
from armlab.log.table import Table

__all__ = ["read_csv"]

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
CLOCKS = ("t", "time")
_EXACT = 2.0**53  # whole numbers up to here are exact as floats
HEADING = re.compile(r"^(?P<label>.*?)(?:\s+\[(?P<unit>[^\[\]]*)\]|\[(?P<tight>[^\[\]\d][^\[\]]*)\])?$")
NUMBERED = re.compile(
    r"^(?P<name>[A-Za-z]\w*?)(?:_?(?P<number>\d+(?:_\d+)*)|\[(?P<index>\d+)\])$"
)  # q1, q_1, cov1_4, q[1]
DECIMAL_COMMA = re.compile(r"^[+-]?\d+,\d+([eE][+-]?\d+)?$")


def read_csv(
    path: str | Path, *, rate: float | None = None, skip: int = 0, separator: str = ",", every: int = 1
) -> Table:
    """Return the table in a text file with one header line; gzip is unpacked.

    A file that `write` made comes back as it was, by the file beside it, ``run.csv.toml``. Of others:

    Empty fields and "nan" are missing (NaN). Rows that repeat a time are dropped and counted in the notes. A column
    with a word in it is text. Leading "- " of a label, as some ROS exports have, is dropped.

    Parameters
    ----------
    path : the file. Its clock is the column t or time [s, ms, us, ns]; seconds where it has no unit.
    rate : [Hz] of a file without a clock.
    skip : lines before the header.
    separator : between fields.
    every : keep every so many rows; filter first where that folds noise (signals.decimate).

    Returns
    -------
    Table : t = 0 at the first row.

    Raises
    ------
    LogError : no file, no text, no clock, lines of another length, times that run backwards, a unit that is not known,
        names that come twice, a decimal comma; each with the line or the column.
    """
    path = Path(path)
    if (rate is not None and not 0 < rate < np.inf) or skip < 0 or every < 1 or len(separator) != 1:
        raise LogError(
            f"Expected a rate above 0, skip from 0, every from 1 and one character as separator, got {rate}, {skip}, "
            f"{every} and {separator!r}."
        )
    labels, fields = _lines(path, skip, separator)
    beside = read_sidecar(path)
    if beside is not None and beside.labels() == labels and rate is None:
        return _as_written(path, beside, fields[::every])
    values, columns, notes = _columns(path, labels, fields, skip)
    if beside is not None:
        notes.append(f"{path.name}.toml describes other columns and is not used")
    t, notes = _clock(path, values, columns, len(fields), rate, skip, notes)
    kept = np.flatnonzero(np.diff(t, prepend=-np.inf) > 0)
    if len(kept) < len(t):
        notes.append(f"{len(t) - len(kept)} rows that repeat a time are dropped")
    kept = kept[::every]
    values, columns = _together(values, columns)
    source = f"{path.name} sha256 {file_hash(path)}"
    try:
        return Table(
            t[kept] - (t[kept[0]] if len(kept) else 0.0),
            {name: array[kept] for name, array in values.items()},
            columns,
            notes=tuple(notes),
            source=(source,),
        )
    except ArmlabError as error:
        raise LogError(f"Expected columns that fit the glossary in {path}, got others: {error}") from None


def _lines(path: Path, skip: int, separator: str) -> tuple[list[str], list[list[str]]]:
    """Return the labels and the fields of each row."""
    try:
        with path.open("rb") as file:
            found = format_of(file.read(64))
        if found not in ("text", "gzip"):
            raise LogError(f"Expected delimited text at {path}, got a file of format {found}.")
        opener = gzip.open if found == "gzip" else open
        with opener(path, "rt", encoding="utf-8-sig", newline="") as file:
            rows = list(csv.reader(file, delimiter=separator))
    except OSError as error:
        raise LogError(f"Expected a log at {path}, got: {error.strerror or error}.") from None
    except (EOFError, UnicodeDecodeError, csv.Error) as error:
        raise LogError(f"Expected delimited text in UTF-8 at {path}, got something else: {error}.") from None
    rows = rows[skip:]
    while rows and not any(rows[-1]):
        rows.pop()
    if len(rows) < 2:
        raise LogError(f"Expected a header and rows of numbers in {path}, got {len(rows)} lines after {skip} skipped.")
    labels, fields = [label.strip() for label in rows[0]], rows[1:]
    for number, row in enumerate(fields, start=skip + 2):
        if len(row) != len(labels):
            raise LogError(
                f"Expected {len(labels)} fields separated by {separator!r} in line {number} of {path}, got {len(row)}. "
                "Name another separator, or mend the line."
            )
    return labels, fields


def _as_written(path: Path, beside: Sidecar, fields: list[list[str]]) -> Table:
    """Return the table that `write` has written."""
    texts = list(zip(*fields))
    values, at = {}, 1
    described = beside.described()
    try:
        t = _typed("real", texts[0])
        for name, column in described.items():
            size = int(np.prod(column.shape, dtype=int))
            parts = [_typed(column.kind or "real", part) for part in texts[at : at + size]]
            whole = np.stack(parts, axis=1) if size else np.zeros((len(t), 0))
            values[name], at = whole.reshape(len(t), *column.shape), at + size
        source = (f"{path.name} sha256 {file_hash(path)}", *beside.source)
        return Table(t, values, described, t0_ns=beside.t0_ns, clock=beside.clock, notes=beside.notes, source=source)
    except (ArmlabError, ValueError, OverflowError) as error:
        what = str(error).rstrip(".")
        raise LogError(f"Expected the columns that {path.name}.toml describes in {path}, got: {what}.") from None


def _typed(kind: str, texts: Sequence[str]) -> np.ndarray:
    if kind == "text":
        return np.array(texts, dtype=np.str_)
    if kind in ("count", "flag"):
        return np.array([int(text) for text in texts], dtype=np.int64)
    return np.array([text or "nan" for text in texts], dtype=np.float64)


def _columns(
    path: Path, labels: list[str], fields: list[list[str]], skip: int
) -> tuple[dict[str, np.ndarray], dict[str, Column], list[str]]:
    """Return scalar columns in SI with their units ("" where the header has none), and notes."""
    values: dict[str, np.ndarray] = {}
    columns: dict[str, Column] = {}
    notes = []
    for label, texts in zip(labels, zip(*fields)):
        found = HEADING.match(label.removeprefix("- "))
        name, unit = (found["label"], found["unit"] or found["tight"] or "") if found else (label, "")
        if not name or name in values:
            what = f"{name!r} twice" if name else "a column without a name"
            raise LogError(f"Expected names that come once in the header of {path}, got {what}.")
        symbol = glossary.columns().get(name)
        kept = (unit, 1.0) if unit in _glossary_units() else None
        known = kept if symbol is not None and symbol.unit == unit else UNITS.get(unit) or kept
        if known is None:
            raise LogError(
                f"Expected a unit that armlab knows for {name!r} in {path}, got {unit!r}. Known: "
                f"{', '.join(u for u in UNITS if u)}."
            )
        array = _numbers(path, name, texts, skip)
        if array.dtype.kind == "U":
            notes.append(f"{name}: text, because of {next(x for x in texts if not _is_number(x))!r}")
            values[name], columns[name] = array, Column(unit=known[0], kind="text")
        else:
            if name in CLOCKS and array.dtype.kind == "i":
                array = array - array[0]  # before digits are lost
            values[name] = array if known[1] == 1.0 else array * known[1]
            columns[name] = Column(unit=known[0], kind="count" if values[name].dtype.kind == "i" else None)
    return values, columns, notes


def _glossary_units() -> set[str]:
    return {unit for symbol in glossary.symbols().values() for unit in symbol.unit.split(", ")}


def _numbers(path: Path, name: str, texts: Sequence[str], skip: int) -> np.ndarray:
    """Return the numbers (N,) of a column, NaN where empty; words where it has one. Large whole ones stay whole."""
    try:
        array = np.array(texts, dtype=float)
        return array if not array.size or np.abs(array).max() < _EXACT else _whole_numbers(texts, array)
    except ValueError:
        filled = ["nan" if not text.strip() else text for text in texts]
    try:
        return np.array(filled, dtype=float)
    except ValueError:
        for row, text in enumerate(texts):
            if DECIMAL_COMMA.match(text.strip()):
                raise LogError(
                    f"Expected a decimal point in the column {name!r} of {path}, got {text.strip()!r} in line "
                    f"{row + skip + 2}. Export with points."
                ) from None
        return np.array(texts, dtype=np.str_)


def _whole_numbers(texts: Sequence[str], array: np.ndarray) -> np.ndarray:
    try:
        return np.array([int(text) for text in texts], dtype=np.int64)
    except (ValueError, OverflowError):
        return array


def _is_number(text: str) -> bool:
    try:
        float(text.strip() or "nan")
    except ValueError:
        return False
    return True


def _clock(
    path: Path,
    values: dict[str, np.ndarray],
    columns: dict[str, Column],
    rows: int,
    rate: float | None,
    skip: int,
    notes: list[str],
) -> tuple[np.ndarray, list[str]]:
    """Take the clock (N,) [s] out of the columns, or make it of the rate."""
    name = next((clock for clock in CLOCKS if clock in values), None)
    if name is None:
        if rate is None:
            raise LogError(
                f"Expected a column t [s] in {path}, got {', '.join(values)}. Give rate= for samples that are even."
            )
        return np.arange(rows) / rate, notes
    t, unit = values.pop(name), columns.pop(name).unit
    if t.dtype.kind == "U" or unit not in ("s", ""):
        raise LogError(f"Expected times in s, ms, us or ns in the column {name!r} of {path}, got {unit or 'words'}.")
    bad = np.flatnonzero(~np.isfinite(t))
    if len(bad):
        raise LogError(f"Expected a time in every row of {path}, got none in line {bad[0] + skip + 2}.")
    back = np.flatnonzero(np.diff(t) < 0)
    if len(back):
        row = int(back[0]) + 1
        raise LogError(
            f"Expected times that do not run backwards in {path}, got {t[row]:.9g} s in line {row + skip + 2} after "
            f"{t[row - 1]:.9g} s ({len(back)} such rows). Cut the file there, or mend its clock."
        )
    return t, notes


def _together(
    values: dict[str, np.ndarray], columns: dict[str, Column]
) -> tuple[dict[str, np.ndarray], dict[str, Column]]:
    """Put q1, q2 ... into q (N, n), where the glossary knows q as an array; the others get their unit."""
    groups: dict[str, dict[tuple[int, ...], str]] = {}
    for label in values:
        name, place = _place(label)
        if place and name not in values:
            groups.setdefault(name, {})[place] = label
    groups = {name: group for name, group in groups.items() if _whole(group)}
    result: dict[str, np.ndarray] = {}
    described: dict[str, Column] = {}
    for label, array in values.items():
        name, place = _place(label)
        if place and name in groups:
            if name not in result:
                group = groups[name]
                ordered = [values[group[at]] for at in sorted(group)]
                result[name] = np.stack(ordered, axis=1).reshape(len(array), *np.max(list(group), axis=0))
                described[name] = Column(unit=_shared_unit(name, [columns[member] for member in group.values()]))
        else:
            unit = columns[label].unit or (None if label in glossary.columns() else "1")
            result[label], described[label] = array, Column(unit=unit, kind=columns[label].kind)
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
    return set(group) == {tuple(k + 1 for k in at) for at in np.ndindex(*np.max(list(group), axis=0))}


def _shared_unit(name: str, members: list[Column]) -> str | None:
    """Return the unit of components that are one column; None for that of the glossary."""
    units, known = {member.unit for member in members}, glossary.columns()[name].unit
    if units <= {"", *known.split(", ")}:
        return None
    if len(units) > 1:
        listed = ", ".join(sorted(str(unit) for unit in units))
        raise LogError(f"Expected one unit for the components of {name}, got {listed}. Convert them.")
    return units.pop()
