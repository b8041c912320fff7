"""Delimited text: `read_csv`, `write_csv`, bounded lines, and ``run.csv.toml`` with what headings cannot say.

``t [s],q1 [rad],q2 [rad],grip [N]`` becomes the columns q (N, 2) and grip (N,). What `log.write` has written, with its
description beside it, comes back as it was. Text that is nothing but numbers is JSON but for its brackets, and JSON is
read five times as fast.
"""

from __future__ import annotations

import csv
import gzip
import io
import re
import zlib
from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache, partial
from itertools import islice, pairwise
from pathlib import Path
from typing import Any, BinaryIO, cast

import msgspec
import numpy as np
import tomli_w

from armlab._numbers import number
from armlab._toml import parsed
from armlab.errors import LogError
from armlab.log.column import refuse_ragged
from armlab.log.file_formats.description import (
    Description,
    Progress,
    components,
    labelled_table,
    names_of,
    put_together,
)
from armlab.log.file_formats.opening import FIRST, format_of
from armlab.log.table import Table

LONGEST = 1 << 20
"""Characters of a line: 40 000 numbers with all their digits."""

_UNPACKED, _RATIO = 1 << 24, 200  # bytes of any file; above that, for each of its own: gzip reaches 1030, an arm that
# stands still with 300 columns that never change 154, one that moves 25
_LINES = 1 << 18  # of any file; above that, one for each byte: a time that advances takes three bytes or more
_PIECE = 1 << 16


def open_text(path: Path) -> BinaryIO:
    """Open a text file, packed or not; what is read of a packed one is bounded."""
    with path.open("rb") as file:
        found = format_of(file.read(FIRST))
    if found not in ("text", "gzip"):
        raise LogError(f"Expected delimited text at {path}, got a file of format {found}.")
    if found == "text":
        return path.open("rb")
    about = path.stat()
    _check_unpacked(path, about.st_size, about.st_mtime_ns)
    return cast(BinaryIO, gzip.open(path))


def rows_in(path: Path, separator: str) -> Iterator[list[str]]:
    """Yield the fields of each line of a text file, packed or not."""
    try:
        with open_text(path) as raw, io.TextIOWrapper(raw, encoding="utf-8-sig", newline="") as file:
            yield from csv.reader(_lines(file, path), delimiter=separator)
    except OSError as error:
        raise LogError(f"Expected a log at {path}, got: {error.strerror or error}.") from None
    except (EOFError, zlib.error, UnicodeDecodeError, csv.Error) as error:
        raise LogError(f"Expected delimited text in UTF-8 at {path}, got something else: {error}.") from None


def _lines(file: io.TextIOWrapper, path: Path) -> Iterator[str]:
    for count, line in enumerate(iter(partial(file.readline, LONGEST + 1), ""), start=1):
        if len(line) > LONGEST:
            raise LogError(
                f"Expected at most {LONGEST} characters in line {count} of {path}, got more. End each row with a line "
                "break, or write fewer columns."
            )
        yield line


@lru_cache(maxsize=4)  # a reader opens a file several times
def _check_unpacked(path: Path, size: int, mtime_ns: int) -> None:
    """Refuse a gzip file that unpacks to far more than its size: counted to the end before anything is made of it."""
    bytes_left, lines_left = max(_UNPACKED, _RATIO * size), max(_LINES, size)
    most = f"{bytes_left} bytes of text, {_RATIO} times its size, and {lines_left} lines"
    with gzip.open(path) as file:
        while piece := file.read(_PIECE):
            bytes_left -= len(piece)
            lines_left -= piece.count(b"\n") + piece.count(b"\r")
            if bytes_left < 0 or lines_left < 0:
                raise LogError(f"Expected at most {most} in {path}, got more. If you trust it, unpack it with gunzip.")


def sidecar_path(path: Path) -> Path:
    """Return the name of the file beside a CSV file: ``run.csv.toml`` of ``run.csv``."""
    return path.with_name(f"{path.name}.toml")


def describe(table: Table) -> str:
    """Return the text of the file for a table."""
    return tomli_w.dumps(msgspec.to_builtins(Description.of(table)))


def read_sidecar(path: Path) -> Description | None:
    """Return what the file beside a CSV file says, None where there is none."""
    beside = sidecar_path(path)
    try:
        return msgspec.convert(parsed(beside.read_text(encoding="utf-8")), Description)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise LogError(f"Expected to read {beside}, got: {error.strerror}.") from None
    except (ValueError, msgspec.ValidationError) as error:
        what = str(error).rstrip(".")
        raise LogError(
            f"Expected the columns of {path.name} in {beside}, got: {what}. Remove it, or mend it."
        ) from None


BLOCK = 1 << 18  # bytes of text at a time
_ROWS = 1000  # at a time
_EMPTY = ((b",,", b",null,"), (b",,", b",null,"), (b",\n", b",null\n"), (b"\n,", b"\nnull,"))  # fields
_NUMERIC = b"0123456789+-.eE, \r\n"
_EXACT = 2.0**53  # whole numbers up to here are exact as floats
_WHOLE = ("count", "flag")  # kinds of whole numbers
DECIMAL_COMMA = re.compile(r"^[+-]?\d+,\d+([eE][+-]?\d+)?$")


def read_csv(
    path: str | Path,
    *,
    rate: float | None = None,
    skip: int = 0,
    separator: str = ",",
    every: int = 1,
    raw: bool = False,
) -> Table:
    """Return the table in a text file with one header line; gzip is unpacked.

    A file that `write` made comes back as it was, by the file beside it, ``run.csv.toml``. Of others:

    Empty fields and "nan" are missing (NaN). Rows whose time does not advance are dropped, counted in the notes and
    warned of by their lines. A column with a word in it is text. Leading "- " of a label, as some ROS exports have, is
    dropped.

    Parameters
    ----------
    path : the file. Its clock is the column t or time [s, ms, us, ns]; seconds where it has no unit.
    rate : [Hz] of a file without a clock.
    skip : lines before the header.
    separator : between fields.
    every : keep every so many rows; filter first where that folds noise (signals.decimate).
    raw : keep rows whose time does not advance.

    Returns
    -------
    Table : t = 0 at the first row.

    Raises
    ------
    LogError : no file, no text, no clock, lines of another length, a unit that is not known, names that come
        twice, a decimal comma; each with the line or the column.
    """
    path, rate = Path(path), None if rate is None else number(rate, "the rate [Hz]", LogError)
    if (rate is not None and not 0 < rate < np.inf) or skip < 0 or every < 1 or len(separator) != 1:
        raise LogError(
            f"Expected a rate above 0, skip from 0, every from 1 and one character as separator, got {rate}, {skip}, "
            f"{every} and {separator!r}."
        )
    beside = read_sidecar(path)
    header = rows_of(path, separator, skip + 1)[skip:]
    if beside is not None and rate is None and header == [beside.labels()]:
        table = _as_written(path, beside)
        return table if every == 1 else table.rows(slice(None, None, every))
    notes = [] if beside is None else [f"{path.name}.toml describes other columns and is not used"]
    names = names_of(path, [label.strip() for label in header[0]] if header else [])
    found = _numbers_only(path, skip, separator)
    if not found or not len(found[0]):  # words, or what is told by its line
        texts = _texts(path, skip, separator)
        found = [_numbers(path, name, of_one, skip) for (name, _), of_one in zip(names, texts, strict=True)]
        for (name, _), of_one, array in zip(names, texts, found, strict=True):
            if array.dtype.kind == "U":
                notes.append(f"{name}: text, because of {next(x for x in of_one if not _is_number(x))!r}")
    arrays = {name: (array, unit) for (name, unit), array in zip(names, found, strict=True)}
    return labelled_table(
        path, arrays, rate=rate, every=every, notes=notes, row=lambda k: f"line {k + skip + 2}", raw=raw
    )


def rows_of(path: Path, separator: str, count: int | None = None) -> list[list[str]]:
    """Return the fields of the first `count` lines of a text file, of all when None; packed or not."""
    return list(islice(rows_in(path, separator), count))


def _numbers_only(path: Path, skip: int, separator: str) -> list[np.ndarray] | None:
    """Return the columns of a file with only numbers and empty fields below its header; None of others."""
    blocks = []
    try:
        with open_text(path) as file:
            lines = (line.decode("utf-8-sig") for line in iter(partial(file.readline, LONGEST + 1), b""))
            of_header = csv.reader(lines, delimiter=separator)
            header = [next(of_header) for _ in range(skip + 1)][-1]
            while text := file.read(BLOCK):
                rest = file.readline(LONGEST + 1)
                if len(text) - text.rfind(b"\n") - 1 + len(rest) > LONGEST:
                    return None
                blocks.append(_columns(_decoded(text + rest, separator), len(header)))
    except LogError:  # there is too much of it
        raise
    except (OSError, EOFError, zlib.error, ValueError, OverflowError, StopIteration, csv.Error, msgspec.DecodeError):
        return None
    return [_joined(parts) for parts in zip(*blocks, strict=True)] if blocks else [np.zeros(0) for _ in header]


def _decoded(text: bytes, separator: str) -> list[list[Any]]:
    """Return the fields of some lines; None is an empty one."""
    mark = separator.encode()
    if text.translate(None, _NUMERIC.replace(b",", mark)) or separator in ".eE+-0123456789":
        raise ValueError("no numbers")
    lines = text.rstrip(b"\r\n")
    for old, new in ((mark, b","), (b"\r\n", b"\n"), *_EMPTY):
        if old != new and old in lines:  # to look is ten times as fast as to replace
            lines = lines.replace(old, new)
    first, last = (b"null" if one else b"" for one in (lines.startswith(b","), lines.endswith(b",")))
    return msgspec.json.decode(b"[[%b%b%b]]" % (first, lines.replace(b"\n", b"],["), last))


def _columns(rows: list[list[Any]], count: int) -> list[np.ndarray]:
    """Return the columns of some rows; ValueError where a row has another number of fields."""
    block = np.array(rows, dtype=float).reshape(len(rows), count)
    columns = list(block.T)
    for place in np.flatnonzero((np.abs(block) >= _EXACT).any(axis=0)):
        natural = np.array([row[place] for row in rows])
        if natural.dtype == np.int64:
            columns[place] = natural
    return columns


def _joined(parts: Sequence[np.ndarray]) -> np.ndarray:
    """Return the blocks of a column as one; whole numbers where one block needs them and all have them."""
    if any(part.dtype.kind == "i" for part in parts):
        whole = [_whole(part) for part in parts]
        parts = whole if all(part.dtype.kind == "i" for part in whole) else parts
    return np.concatenate(parts)


def _texts(path: Path, skip: int, separator: str, least: int = 2) -> list[list[str]]:
    """Return the texts of each column below the header: as rows they would take twice the memory."""
    rows = islice(rows_in(path, separator), skip, None)
    columns = [[] for _ in next(rows, [])]
    even = _even(rows, len(columns), skip + 2, separator, path)
    while some := list(islice(even, _ROWS)):
        for column, texts in zip(columns, zip(*some, strict=True), strict=True):
            column += texts
    while columns and columns[0] and not any(column[-1] for column in columns):
        for column in columns:
            column.pop()
    count = len(columns[0]) + 1 if columns else 0
    if count < least:
        raise LogError(f"Expected a header and rows of numbers in {path}, got {count} lines after {skip} skipped.")
    return columns


def _even(rows: Iterable[list[str]], width: int, first: int, separator: str, path: Path) -> Iterator[list[str]]:
    """Yield rows of this width; a line of another one is refused, but for empty ones at the end."""
    other = None
    for line, row in enumerate(rows, start=first):
        if other is None and len(row) == width:
            yield row
            continue
        other = other or (line, len(row))
        if any(row):
            raise LogError(
                f"Expected {width} fields separated by {separator!r} in line {other[0]} of {path}, got "
                f"{other[1]}. Name another separator, or mend the line."
            )


def _as_written(path: Path, beside: Description) -> Table:
    """Return the table that `write` has written."""
    kinds = ["real"]
    for column in beside.columns.values():
        kinds += [column.kind] * int(np.prod(column.shape, dtype=int))
    parts = None if "text" in kinds else _numbers_only(path, 0, ",")
    if parts is None:
        fields = _texts(path, 0, ",", least=1)
        try:
            parts = [_typed(kind, texts) for kind, texts in zip(kinds, fields, strict=True)]
        except (ValueError, OverflowError) as error:
            raise LogError(
                f"Expected the columns that {path.name}.toml describes in {path}, got: {str(error).rstrip('.')}."
            ) from None
    else:  # beside a component that a float cannot hold the others stay whole, too
        parts = [_whole(part) if kind in _WHOLE else part for kind, part in zip(kinds, parts, strict=True)]
    return beside.table(path, parts[0], put_together(beside, parts[1:], len(parts[0])))


def _whole(array: np.ndarray) -> np.ndarray:
    """Return whole numbers that a float holds exactly as integers, others as they are."""
    exact = array.dtype.kind == "f" and bool((np.abs(array) < _EXACT).all() and (array == np.round(array)).all())
    return array.astype(np.int64) if exact else array


def _words(texts: Sequence[str], where: str) -> np.ndarray:
    """Return texts (N,); NumPy gives each the room of the longest, four bytes a letter."""
    sizes = [len(text) // 2 + 1 for text in texts]
    refuse_ragged(len(texts), {where: max(sizes, default=0)}, sum(sizes))
    return np.array(texts, dtype=np.str_)


def _typed(kind: str, texts: Sequence[str]) -> np.ndarray:
    if kind == "text":
        return _words(texts, "a column of texts")
    if kind in _WHOLE:
        return np.array([int(text) for text in texts], dtype=np.int64)
    return np.array([text or "nan" for text in texts], dtype=np.float64)


def _numbers(path: Path, name: str, texts: Sequence[str], skip: int) -> np.ndarray:
    """Return the numbers (N,) of a column, NaN where empty; words where it has one. Large whole ones stay whole."""
    filled = [text.strip() or "nan" for text in texts]  # Python knows more kinds of space than NumPy
    try:
        array = np.array(filled, dtype=float)
        return _whole_numbers(texts, array) if (np.abs(array) >= _EXACT).any() else array
    except ValueError:
        for row, text in enumerate(texts):
            if "," in text and DECIMAL_COMMA.match(text.strip()):
                raise LogError(
                    f"Expected a decimal point in the column {name!r} of {path}, got {text.strip()!r} in line "
                    f"{row + skip + 2}. Export with points."
                ) from None
        return _words(texts, f"{path.name}: {name}")


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


ROWS_PER_BLOCK = 10_000  # rows


def write_csv(table: Table, file: BinaryIO, progress: Progress) -> None:
    """Write one line of headings, ``t [s],q1 [rad],...``, and one line per row; the shortest digits that read back."""
    file.write(b",".join(_quoted(label) for label in Description.of(table).labels()) + b"\n")
    columns = [values for _, _, values in components(table)]
    for start, stop in pairwise([*range(0, len(table), ROWS_PER_BLOCK), len(table)]):
        rows = zip(*(_words_of_rows(column[start:stop]) for column in columns), strict=True)
        file.write(b"\n".join(map(b",".join, rows)) + b"\n")
        progress(stop, len(table), "rows")


def _words_of_rows(values: np.ndarray) -> list[bytes]:
    if values.dtype.kind == "U":
        return [_quoted(word, always=True) for word in values.tolist()]
    if values.dtype.kind == "f" and np.isinf(values).any():
        return [b"" if value != value else repr(value).encode() for value in values.tolist()]  # NaN is not itself
    numbers = values.astype(np.int8) if values.dtype.kind == "b" else values
    words = msgspec.json.encode(numbers.tolist())[1:-1].split(b",")  # six times as fast as repr
    if values.dtype.kind == "f" and np.isnan(values).any():
        return [b"" if word == b"null" else word for word in words]
    return words


def _quoted(word: str, always: bool = False) -> bytes:
    is_plain = not (always or any(mark in word for mark in ',"\r\n'))
    return (word if is_plain else '"' + word.replace('"', '""') + '"').encode()
