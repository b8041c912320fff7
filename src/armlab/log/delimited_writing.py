"""`write_csv`: a `Table` becomes delimited text, block by block."""

from __future__ import annotations

from itertools import pairwise
from typing import BinaryIO

import msgspec
import numpy as np

from armlab.log.description import Description, Progress, components
from armlab.log.table import Table

__all__ = ["write_csv"]

BLOCK = 10_000  # rows


def write_csv(table: Table, file: BinaryIO, progress: Progress) -> None:
    """Write one line of headings, ``t [s],q1 [rad],...``, and one line per row; the shortest digits that read back.

    Parameters
    ----------
    table : to write. file : opened for writing. progress : is told the rows.

    Raises
    ------
    OSError : the file cannot be written.
    """
    file.write(b",".join(_quoted(label) for label in Description.of(table).labels()) + b"\n")
    columns = [values for _, _, values in components(table)]
    for start, stop in pairwise([*range(0, len(table), BLOCK), len(table)]):
        rows = zip(*(_words(column[start:stop]) for column in columns), strict=True)
        file.write(b"\n".join(map(b",".join, rows)) + b"\n")
        progress(stop, len(table), "rows")


def _words(values: np.ndarray) -> list[bytes]:
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
