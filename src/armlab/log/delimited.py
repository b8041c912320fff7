"""`read_csv`: delimited text becomes a `Table`; units are in the header.

``t [s],q1 [rad],q2 [rad],grip [N]`` becomes the columns q (N, 2) and grip (N,). What `log.write` has written, with its
description beside it, comes back as it was; long files by pyarrow where that is installed.
"""

from __future__ import annotations

import csv
import gzip
import re
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import TextIO

import numpy as np

from armlab.errors import LogError
from armlab.log.description import Description, put_together
from armlab.log.formats import FIRST, format_of
from armlab.log.labelled import labelled_table, names_of
from armlab.log.sidecar import read_sidecar
from armlab.log.table import Table

__all__ = ["read_csv"]

LONG = 1_000_000  # bytes of a file for which pyarrow, which takes a tenth of a second to load, is worth it
_EXACT = 2.0**53  # whole numbers up to here are exact as floats
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
    beside = read_sidecar(path)
    header = _rows(path, separator, 1)
    if beside is not None and rate is None and header == [beside.labels()]:
        table = _as_written(path, beside)
        return table if every == 1 else table.rows(slice(None, None, every))
    labels, fields = _lines(path, skip, separator)
    notes = [] if beside is None else [f"{path.name}.toml describes other columns and is not used"]
    names = names_of(path, labels)
    arrays = {}
    for (name, unit), texts in zip(names, zip(*fields)):
        arrays[name] = (_numbers(path, name, texts, skip), unit)
        if arrays[name][0].dtype.kind == "U":
            notes.append(f"{name}: text, because of {next(x for x in texts if not _is_number(x))!r}")
    return labelled_table(path, arrays, rate=rate, every=every, notes=notes, row=lambda k: f"line {k + skip + 2}")


def _open(path: Path) -> TextIO:
    """Open a text file, packed or not; of another format it is refused."""
    with path.open("rb") as file:
        found = format_of(file.read(FIRST))
    if found not in ("text", "gzip"):
        raise LogError(f"Expected delimited text at {path}, got a file of format {found}.")
    if found == "gzip":
        return gzip.open(path, "rt", encoding="utf-8-sig", newline="")
    return path.open(encoding="utf-8-sig", newline="")


def _rows(path: Path, separator: str, count: int | None = None) -> list[list[str]]:
    """Return the fields of the first lines, of all when None."""
    try:
        with _open(path) as file:
            return list(islice(csv.reader(file, delimiter=separator), count))
    except OSError as error:
        raise LogError(f"Expected a log at {path}, got: {error.strerror or error}.") from None
    except (EOFError, UnicodeDecodeError, csv.Error) as error:
        raise LogError(f"Expected delimited text in UTF-8 at {path}, got something else: {error}.") from None


def _lines(path: Path, skip: int, separator: str, least: int = 2) -> tuple[list[str], list[list[str]]]:
    """Return the labels and the fields of each row."""
    rows = _rows(path, separator)[skip:]
    while rows and not any(rows[-1]):
        rows.pop()
    if len(rows) < least:
        raise LogError(f"Expected a header and rows of numbers in {path}, got {len(rows)} lines after {skip} skipped.")
    labels, fields = [label.strip() for label in rows[0]], rows[1:]
    for number, row in enumerate(fields, start=skip + 2):
        if len(row) != len(labels):
            raise LogError(
                f"Expected {len(labels)} fields separated by {separator!r} in line {number} of {path}, got {len(row)}. "
                "Name another separator, or mend the line."
            )
    return labels, fields


def _as_written(path: Path, beside: Description) -> Table:
    """Return the table that `write` has written."""
    kinds = ["real"]
    for column in beside.columns.values():
        kinds += [column.kind] * int(np.prod(column.shape, dtype=int))
    parts = _quickly(path, kinds) if path.stat().st_size >= LONG else None
    if parts is None:
        _, fields = _lines(path, 0, ",", least=1)
        try:
            parts = [_typed(kind, texts) for kind, texts in zip(kinds, zip(*fields) if fields else [()] * len(kinds))]
        except (ValueError, OverflowError) as error:
            raise LogError(
                f"Expected the columns that {path.name}.toml describes in {path}, got: {str(error).rstrip('.')}."
            ) from None
    return beside.table(path, parts[0], put_together(beside, parts[1:], rows=len(parts[0])))


def _quickly(path: Path, kinds: Sequence[str]) -> list[np.ndarray] | None:
    """Return the components by pyarrow; None without it, and where it stumbles: the slow way says in which line."""
    try:
        import pyarrow as pa
        from pyarrow import csv as reader
    except ImportError:
        return None
    types = {"text": pa.string(), "count": pa.int64(), "flag": pa.int64()}
    names = [str(place) for place in range(len(kinds))]
    try:
        with path.open("rb") as raw, gzip.open(raw) if raw.read(2) == b"\x1f\x8b" else raw as file:
            raw.seek(0)
            found = reader.read_csv(
                file,
                reader.ReadOptions(column_names=names, skip_rows_after_names=1),
                reader.ParseOptions(newlines_in_values="text" in kinds),
                reader.ConvertOptions(
                    column_types={name: types.get(kind, pa.float64()) for name, kind in zip(names, kinds, strict=True)},
                    null_values=[""],
                    strings_can_be_null=False,
                ),
            )
    except (pa.ArrowException, OSError, EOFError):
        return None
    return [
        np.array(column.to_pylist(), dtype=np.str_) if kind == "text" else column.to_numpy()
        for column, kind in zip(found.columns, kinds, strict=True)
    ]


def _typed(kind: str, texts: Sequence[str]) -> np.ndarray:
    if kind == "text":
        return np.array(texts, dtype=np.str_)
    if kind in ("count", "flag"):
        return np.array([int(text) for text in texts], dtype=np.int64)
    return np.array([text or "nan" for text in texts], dtype=np.float64)


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
