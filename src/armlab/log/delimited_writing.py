"""`write_csv`: a `Table` becomes delimited text, block by block; by pyarrow where that is installed and worth it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from armlab.log.description import Description, Progress, components
from armlab.log.table import Table

if TYPE_CHECKING:
    import pyarrow as pa

__all__ = ["write_csv"]

BLOCK = 10_000  # rows
MANY = 300_000  # numbers for which pyarrow, which takes a tenth of a second to load, is worth it


def write_csv(table: Table, file: BinaryIO, progress: Progress) -> None:
    """Write one line of headings, ``t [s],q1 [rad],...``, and one line per row; the shortest digits that read back.

    Parameters
    ----------
    table : to write. file : opened for writing. progress : is told the rows.

    Raises
    ------
    OSError : the file cannot be written.
    """
    file.write(",".join(_quoted(label) for label in Description.of(table).labels()).encode() + b"\n")
    columns = [values for _, _, values in components(table)]
    write = _writer(columns, file)
    for start, stop in pairwise([*range(0, len(table), BLOCK), len(table)]):
        write([column[start:stop] for column in columns])
        progress(stop, len(table), "rows")


def _writer(columns: Sequence[np.ndarray], file: BinaryIO) -> Any:
    """Return the function that writes the columns of one block."""
    if sum(column.size for column in columns) >= MANY:
        try:
            import pyarrow as pa
            from pyarrow import csv as writer
        except ImportError:
            pass
        else:
            options = writer.WriteOptions(include_header=False, batch_size=BLOCK)
            return lambda block: writer.write_csv(_arrow(block), pa.PythonFile(file, mode="w"), options)
    return lambda block: file.writelines(_text(block))


def _arrow(block: Iterable[np.ndarray]) -> pa.Table:
    import pyarrow as pa

    arrays = []
    for values in block:
        if values.dtype.kind == "U":
            arrays.append(pa.array(values.tolist(), pa.string()))
        else:
            whole = values.astype(np.int8) if values.dtype.kind == "b" else np.ascontiguousarray(values)
            arrays.append(pa.array(whole, from_pandas=True))  # NaN is an empty field
    return pa.table(arrays, names=[str(place) for place in range(len(arrays))])


def _text(block: Iterable[np.ndarray]) -> Iterator[bytes]:
    for row in zip(*(_words(values) for values in block), strict=True):
        yield (",".join(row) + "\n").encode()


def _words(values: np.ndarray) -> list[str]:
    if values.dtype.kind == "U":
        return ['"' + word.replace('"', '""') + '"' for word in values.tolist()]
    if values.dtype.kind == "b":
        values = values.astype(int)
    words = str(values.tolist())[1:-1].split(", ")  # several times as fast as word by word
    if values.dtype.kind == "f" and np.isnan(values).any():
        return ["" if word == "nan" else word for word in words]
    return words


def _quoted(word: str) -> str:
    return '"' + word.replace('"', '""') + '"' if any(mark in word for mark in ',"\r\n') else word
