"""One column of a table: shape, unit, frame, labels, kind, the aliases of its name; ragged columns."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from armlab import glossary
from armlab.errors import LogError, ShapeError, UnknownName

KINDS = ("real", "angle", "pose", "quaternion", "count", "flag", "text")
"""Kinds of columns; the kind decides how a column is stored and how it is resampled."""


@dataclass(frozen=True, slots=True)
class Column:
    """Description of one column: everything but its values.

    Known names take what is not given from the glossary; a new name must state its unit.

    Attributes
    ----------
    shape : shape of one row; ``()`` for a scalar per row.
    unit : SI unit, "1" for none; None for "as in the glossary".
    frame : axes the numbers are in; None for "as in the glossary".
    labels : names of the components along the first axis of a row (joint names), or empty.
    kind : one of `KINDS`; None for "as in the glossary", else real.
    """

    shape: tuple[int, ...] = ()
    unit: str | None = None
    frame: str | None = None
    labels: tuple[str, ...] = ()
    kind: str | None = None


def resolved(column: Column, name: str) -> Column:
    """Return the description with everything that the glossary knows about `name` filled in, or raise."""
    symbol = glossary.columns().get(name)
    if symbol is None and column.unit is None:
        raise ShapeError(
            f"Expected a unit for the column {name!r}, which the glossary does not know; give unit='1' for none."
        )
    for what, given in (("unit", column.unit), ("frame", column.frame)):
        known = getattr(symbol, what, None)
        if known is not None and given is not None and given != known:
            raise ShapeError(
                f"Expected {what} {known!r} for the column {name!r} (glossary), got {given!r}; "
                "convert the values or use another name."
            )
    kind = column.kind or (symbol.kind if symbol else "real")
    if kind not in KINDS:
        raise UnknownName.among("kind of column", kind, KINDS)
    if symbol:
        _check_row_shape(name, column.shape, symbol.shape)
    if column.labels and (not column.shape or len(column.labels) != column.shape[0]):
        count = column.shape[0] if column.shape else 0
        raise ShapeError(f"Expected {count} labels for the column {name!r}, got {len(column.labels)}.")
    unit = column.unit if column.unit is not None else (symbol.unit if symbol else "1")
    frame = column.frame if column.frame is not None else (symbol.frame if symbol else "")
    return replace(column, unit=unit, frame=frame, kind=kind, labels=tuple(column.labels))


def heading(column: Column, name: str) -> str:
    """Return the label of an axis or a header: ``"tau [N m]"``."""
    return name if column.unit in (None, "", "1") else f"{name} [{column.unit}]"


def _check_row_shape(name: str, shape: tuple[int, ...], words: str) -> None:
    """Compare a row shape with the glossary's, for example "(N, 4, 4)"; letters match any size."""
    expected = [word.strip() for word in words.strip("()").split(",") if word.strip()][1:]
    fits = len(expected) == len(shape) and all(
        not word.isdigit() or int(word) == size for word, size in zip(expected, shape, strict=True)
    )
    if not fits:
        got = ", ".join(["N", *map(str, shape)]) + ("," if not shape else "")
        raise ShapeError(f"Expected shape {words} for the column {name!r} (glossary), got ({got}).")


def stored(name: str, values: Any, column: Column | None) -> tuple[np.ndarray, Column, str]:
    """Return values as they are kept (C-contiguous, little-endian, read-only), their description, and a note or ""."""
    raw = np.asarray(values)
    if name == "t":
        raise ShapeError("Expected columns besides t, the clock of the table, got one of that name. Rename it.")
    if raw.ndim == 0:
        raise ShapeError(f"Expected one value per row for the column {name!r}, got a single value.")
    described = resolved(replace(column or Column(), shape=raw.shape[1:]), name)
    note = ""
    if described.kind in ("count", "flag") and raw.dtype.kind == "f" and not np.isfinite(raw).all():
        note = f"{name}: {described.kind} with missing values, kept as real"
        described = replace(described, kind="real")
    return frozen(_cast(name, raw, described.kind or "real")), described, note


def _cast(name: str, raw: np.ndarray, kind: str) -> np.ndarray:
    """Return the array in the storage type of its kind."""
    if kind == "text":
        return raw if raw.dtype.kind == "U" else raw.astype(np.str_)
    if raw.dtype.kind not in "biuf":
        raise ShapeError(f"Expected numbers in the column {name!r} of kind {kind}, got values of type {raw.dtype}.")
    if kind == "flag":
        wanted = np.dtype(bool)
    else:
        wanted = np.dtype("<i8") if kind == "count" else np.dtype("<f8")
    if raw.dtype == wanted:
        return raw
    with np.errstate(invalid="ignore"):  # what does not fit is refused below
        cast = raw.astype(wanted)
    if kind in ("count", "flag") and not np.array_equal(cast, raw):
        raise ShapeError(f"Expected whole numbers that fit {wanted} in the column {name!r} of kind {kind}.")
    return cast


def frozen(array: np.ndarray) -> np.ndarray:
    """Return the array C-contiguous and read-only, copied if anyone could still write to its memory."""
    whole = np.ascontiguousarray(array) if array.ndim else array
    if whole is array and _writable_somewhere(array):
        whole = array.copy()
    whole.flags.writeable = False
    return whole


def _writable_somewhere(array: np.ndarray) -> bool:
    """Tell whether the memory can be written through this array or through what it views."""
    seen: Any = array
    while isinstance(seen, np.ndarray):
        if seen.flags.writeable:
            return True
        seen = seen.base
    return not (seen is None or isinstance(seen, bytes))


OLD_NAMES = {"pos": "q", "vel": "qd", "trq": "tau", "pos_o": "q_ref", "vel_o": "qd_ref", "trq_o": "tau_ref"}
OLD_NAMES |= {"timestamp": "t", "seqnum": "seq"}
"""Names of the fields of Robotlab.jl's logs -> ours."""


def alias(name: str) -> str:
    """Return a column name with ``: . [ ]`` replaced by ``_`` and outer ``_`` stripped, as the old tools did."""
    return re.sub(r"[:.\[\]]", "_", name).strip("_")


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Return the sorting key in which digit groups compare as numbers."""
    pieces = re.findall(r"\d+|\D+", name)
    return [(0, int(piece), "") if piece.isdigit() else (1, 0, piece) for piece in pieces]


_LARGEST, _CELLS_PER_NUMBER = 1 << 31, 512  # bytes of columns, and cells per number: one of 500 frames in each message


def refuse_ragged(count: int, widths: Mapping[str, int], held: int) -> None:
    """Refuse values that differ so much that their columns are large and hardly hold anything: `widths` by name."""
    cells = count * sum(widths.values())
    if 8 * cells > _LARGEST and cells > _CELLS_PER_NUMBER * held:
        widest = max(widths, key=lambda path: widths[path])
        raise LogError(
            f"Expected values that are alike, got {count} rows with {held} numbers, up to {widths[widest]} in "
            f"{widest[:80]}: {len(widths)} name(s) that would take {cells} cells."
        )
