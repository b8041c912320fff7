"""Lines of a text file, packed or not; their length and what is unpacked are bounded before there is memory for it."""

from __future__ import annotations

import csv
import gzip
import io
import zlib
from collections.abc import Iterator
from functools import lru_cache, partial
from pathlib import Path
from typing import BinaryIO, cast

from armlab.errors import LogError
from armlab.log.formats import FIRST, format_of

__all__ = ["LONGEST", "open_text", "rows_in"]

LONGEST = 1 << 20
"""Characters of a line: 40 000 numbers with all their digits."""

_UNPACKED, _RATIO = 1 << 24, 200  # bytes of any file; above that, for each of its own: gzip reaches 1030, an arm that
# stands still with 300 columns that never change 154, one that moves 25
_LINES = 1 << 18  # of any file; above that, one for each byte: a time that advances takes three bytes or more
_PIECE = 1 << 16


def open_text(path: Path) -> BinaryIO:
    """Open a text file, packed or not; what is read of a packed one is bounded.

    Parameters
    ----------
    path : of the file.

    Raises
    ------
    LogError : another format, or it unpacks to far more than its size. OSError : no file.
    """
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
    """Yield the fields of each line of a text file, packed or not.

    Parameters
    ----------
    path : of the file. separator : between fields.

    Raises
    ------
    LogError : no file, no text in UTF-8, a line of more than `LONGEST` characters, a packed file that unpacks to far
        more than its size.
    """
    try:
        with open_text(path) as raw, io.TextIOWrapper(raw, encoding="utf-8-sig", newline="") as file:
            yield from csv.reader(_lines(file, path), delimiter=separator)
    except OSError as error:
        raise LogError(f"Expected a log at {path}, got: {error.strerror or error}.") from None
    except (EOFError, zlib.error, UnicodeDecodeError, csv.Error) as error:
        raise LogError(f"Expected delimited text in UTF-8 at {path}, got something else: {error}.") from None


def _lines(file: io.TextIOWrapper, path: Path) -> Iterator[str]:
    for number, line in enumerate(iter(partial(file.readline, LONGEST + 1), ""), start=1):
        if len(line) > LONGEST:
            raise LogError(
                f"Expected at most {LONGEST} characters in line {number} of {path}, got more. End each row with a line "
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
