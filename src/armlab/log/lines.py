"""Lines of a text file, packed or not; their length and what is unpacked are bounded before there is memory for it."""

from __future__ import annotations

import csv
import gzip
import io
import zlib
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

from armlab.errors import LogError
from armlab.log.formats import FIRST, format_of

__all__ = ["LONGEST", "open_text", "rows_in"]

LONGEST = 1 << 20
"""Characters of a line: 40 000 numbers with all their digits."""

_UNPACKED, _RATIO = 1 << 25, 200  # bytes of any file; above that, for each of its own: gzip reaches 1030, an arm that
# stands still with 300 columns that never change 154, one that moves 25


def open_text(path: Path) -> BinaryIO:
    """Open a text file, packed or not; what is read of a packed one is bounded.

    Parameters
    ----------
    path : of the file.

    Raises
    ------
    LogError : another format. OSError : no file.
    """
    with path.open("rb") as file:
        found = format_of(file.read(FIRST))
    if found not in ("text", "gzip"):
        raise LogError(f"Expected delimited text at {path}, got a file of format {found}.")
    return io.BufferedReader(_Unpacked(path), 1 << 16) if found == "gzip" else path.open("rb")


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


class _Unpacked(io.RawIOBase):
    """What is in a gzip file, as long as it is not far larger than the file."""

    def __init__(self, path: Path) -> None:
        self._path, self._file, self._count = path, gzip.GzipFile(path), 0
        self._most = max(_UNPACKED, _RATIO * path.stat().st_size)

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any, /) -> int:
        size = self._file.readinto(buffer)
        self._count += size
        if self._count > self._most:
            raise LogError(
                f"Expected at most {self._most} bytes of text in {self._path}, {_RATIO} times its size, got more. If "
                "you trust it, unpack it with gunzip and read that."
            )
        return size

    def close(self) -> None:
        self._file.close()
        super().close()
