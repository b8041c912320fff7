"""A `Table` in a MAT file of version 5: one variable per column, and a struct with their units.

In MATLAB ``run = load('run.mat')`` gives ``run.t``, ``run.q`` (N, n), ``run.units.q``; ``run.names`` holds the true
names of columns whose own are none in MATLAB, ``run.armlab`` everything else as JSON.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from armlab.errors import LogError
from armlab.log.description import Description, Progress, distinct, of_json
from armlab.log.foreign import foreign_table
from armlab.log.mat_file import read_variables
from armlab.log.table import Table

__all__ = ["matlab_names", "read_mat_table", "write_mat"]

LARGEST = 2**31 - 2**16  # bytes of a variable, with room for what stands before its numbers
LONGEST = 59  # characters of a name: 63 with what may be put behind it
TAKEN = ("t", "units", "names", "armlab")
KEYWORDS = (
    "break", "case", "catch", "classdef", "continue", "else", "elseif", "end", "for", "function", "global", "if",
    "otherwise", "parfor", "persistent", "return", "spmd", "switch", "try", "while",
)  # fmt: skip


def matlab_names(names: Iterable[str]) -> dict[str, str]:
    """Return the variable of each column: its name where MATLAB allows that, else one like it.

    Parameters
    ----------
    names : of the columns.
    """
    return distinct({name: _valid(name) for name in names}, TAKEN)


def write_mat(table: Table, file: BinaryIO, progress: Progress) -> None:
    """Write a MAT file of version 5.

    Parameters
    ----------
    table : to write. file : opened for writing. progress : is told the bytes.

    Raises
    ------
    LogError : a column of 2 GB or more. OSError : the file cannot be written.
    """
    from scipy.io import savemat

    for name in ("t", *table.names):
        if table[name].nbytes > LARGEST:
            raise LogError(
                f"Expected columns below 2 GB for a MAT file of version 5, got {table[name].nbytes / 1e9:.1f} GB in "
                f"{name!r}. Write HDF5, a name that ends in .h5."
            )
    names = matlab_names(table.names)
    variables: dict[str, Any] = {"t": table.t}
    variables |= {own: _cells(table[name]) for name, own in names.items()}
    variables["units"] = {"t": "s", **{own: table.units[name] for name, own in names.items()}}
    changed = {own: name for name, own in names.items() if own != name}
    if changed:
        variables["names"] = changed
    variables["armlab"] = Description.of(table).json()
    whole = sum(array.nbytes for array in (table.t, *table.values.values()))
    savemat(_Told(file, whole, progress), variables, long_field_names=True, oned_as="column")


def read_mat_table(path: Path, *, raw: bool = False) -> Table:
    """Return the table in a MAT file: one of `write_mat`, or the arrays of another program by `foreign_table`.

    Parameters
    ----------
    path : of the file, v5 to v7.3. raw : keep rows whose time does not advance.

    Raises
    ------
    LogError : a damaged file, no clock, or what the description in it does not fit. MissingExtra : v7.3 without h5py.
    """
    found, left_out = read_variables(path)
    text = found.get("armlab")
    if text is None or text.dtype.kind != "U" or text.shape != (1, 1):
        return foreign_table(path, {name: (value, "") for name, value in found.items()}, left_out, raw)
    about = of_json(str(text[0, 0]), path)
    names = matlab_names(about.columns)
    missing = [name for name, own in {"t": "t", **names}.items() if own not in found]
    if missing:
        raise LogError(f"Expected the variables that are described in {path}, got none for {', '.join(missing)}.")
    return about.table(path, np.ravel(found["t"]), {name: found[own] for name, own in names.items()})


def _valid(name: str) -> str:
    """Return a name that MATLAB allows, the same where it does."""
    valid = re.sub(r"\W", "_", name, flags=re.ASCII)
    return (valid if valid[:1].isalpha() and valid not in KEYWORDS else f"x{valid}")[:LONGEST]


def _cells(values: np.ndarray) -> np.ndarray:
    """Return numbers as they are, texts as a cell of each."""
    if values.dtype.kind != "U":
        return values
    cells = np.empty(values.shape if values.ndim > 1 else (len(values), 1), dtype=object)
    cells[...] = values.astype(object).reshape(cells.shape)
    return cells


class _Told:
    """A file that tells each percent of the bytes that go into it."""

    def __init__(self, file: BinaryIO, whole: int, progress: Progress) -> None:
        self._file, self._whole, self._progress = file, whole, progress
        self._done = self._told = 0
        self.tell, self.seek = file.tell, file.seek

    def write(self, data: bytes) -> int:
        self._done += memoryview(data).nbytes
        if 100 * (self._done - self._told) >= self._whole:
            self._told = min(self._done, self._whole)
            self._progress(self._told, self._whole, "bytes")
        return self._file.write(data)
