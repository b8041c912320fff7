"""Arrays from files of other programs become a `Table`: names of the old tools, one sample per column or per row."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from armlab.errors import LogError
from armlab.log.labelled import CLOCKS, labelled_table
from armlab.log.labels import OLD_NAMES
from armlab.log.table import Table

__all__ = ["foreign_table"]


def foreign_table(
    path: Path, arrays: Mapping[str, tuple[np.ndarray, str]], left_out: Sequence[str] = (), raw: bool = False
) -> Table:
    """Return the table of arrays by name.

    The clock is t, time or timestamp. Other arrays have as many rows, or as many columns: they are transposed. Names of
    the ancestors' logs are read as ours. What has another size is left out, and named in the notes.

    Parameters
    ----------
    path : where they are from. arrays : name -> values and unit, "" for none.
    left_out : names of what was not read, for the notes. raw : keep rows whose time does not advance.

    Raises
    ------
    LogError : no clock, a unit that is not known, columns that the glossary has otherwise.
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
