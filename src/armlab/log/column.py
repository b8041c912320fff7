"""Column descriptions of a table: shape, unit, frame, labels, kind, aliases; ragged columns; interpolation."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from armlab import glossary
from armlab._display import Shown
from armlab.errors import LogError, ShapeError, UnknownName
from armlab.lie import quaternion, se3, so3

KINDS = ("real", "angle", "pose", "quaternion", "count", "flag", "text")
"""Kinds of columns; the kind determines storage and resampling."""


@dataclass(frozen=True, slots=True, repr=False)
class Column(Shown):
    """Description of one column.

    For names in the glossary, missing attributes are taken from the glossary entry. Other names require a unit.

    Attributes
    ----------
    shape : tuple of int
        Shape of one row; ``()`` for a scalar per row.
    unit : str
        SI unit, "1" if dimensionless; default: as in the glossary.
    frame : str
        Axes of the values; default: as in the glossary.
    labels : tuple of str
        Names of the components along the first axis of a row (joint names), or empty.
    kind : str
        One of `KINDS`; default: as in the glossary, else real.
    """

    shape: tuple[int, ...] = ()
    unit: str | None = None
    frame: str | None = None
    labels: tuple[str, ...] = ()
    kind: str | None = None


def resolved(column: Column, name: str) -> Column:
    """Complete a description from the glossary; raise an error if the two contradict each other."""
    symbol = glossary.columns().get(name)
    if symbol is None and column.unit is None:
        raise ShapeError(
            f"Expected a unit for the column {name!r}, which is not in the glossary; pass unit='1' for a "
            "dimensionless column."
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
    """Return an axis label or a column header, such as ``"tau [N m]"``."""
    return name if column.unit in (None, "", "1") else f"{name} [{column.unit}]"


def _check_row_shape(name: str, shape: tuple[int, ...], words: str) -> None:
    """Compare a row shape with the glossary entry, such as "(N, 4, 4)"; letters match any size."""
    expected = [word.strip() for word in words.strip("()").split(",") if word.strip()][1:]
    fits = len(expected) == len(shape) and all(
        not word.isdigit() or int(word) == size for word, size in zip(expected, shape, strict=True)
    )
    if not fits:
        got = ", ".join(["N", *map(str, shape)]) + ("," if not shape else "")
        raise ShapeError(f"Expected shape {words} for the column {name!r} (glossary), got ({got}).")


def stored(name: str, values: Any, column: Column | None) -> tuple[np.ndarray, Column, str]:
    """Return the stored values (C-contiguous, little-endian, read-only), their description, and a note or ""."""
    raw = np.asarray(values)
    if name == "t":
        raise ShapeError("Expected column names other than t, which is the table's clock, got t. Rename it.")
    if raw.ndim == 0:
        raise ShapeError(f"Expected one value per row for the column {name!r}, got a single value.")
    described = resolved(replace(column or Column(), shape=raw.shape[1:]), name)
    note = ""
    if described.kind in ("count", "flag") and raw.dtype.kind == "f" and not np.isfinite(raw).all():
        note = f"{name}: stored as real because this {described.kind} column has missing values"
        described = replace(described, kind="real")
    return frozen(_cast(name, raw, described.kind or "real")), described, note


def _cast(name: str, raw: np.ndarray, kind: str) -> np.ndarray:
    if kind == "text":
        return raw if raw.dtype.kind == "U" else raw.astype(np.str_)
    if raw.dtype.kind not in "biuf":
        raise ShapeError(f"Expected numbers in the column {name!r} of kind {kind}, got values of type {raw.dtype}.")
    dtype = np.dtype({"flag": "bool", "count": "<i8"}.get(kind, "<f8"))
    if raw.dtype == dtype:
        return raw
    with np.errstate(invalid="ignore"):  # invalid values are rejected below
        cast = raw.astype(dtype)
    if kind in ("count", "flag") and not np.array_equal(cast, raw):
        raise ShapeError(
            f"Expected integers that fit {dtype} in the column {name!r} of kind {kind}, "
            "got fractional or out-of-range values."
        )
    return cast


def frozen(array: np.ndarray) -> np.ndarray:
    """Return the array as C-contiguous and read-only; copy it if its memory is writable through another array."""
    whole = np.ascontiguousarray(array) if array.ndim else array
    if whole is array and _writable_somewhere(array):
        whole = array.copy()
    whole.flags.writeable = False
    return whole


def _writable_somewhere(array: np.ndarray) -> bool:
    """Return whether the memory is writable through this array or its bases."""
    seen: Any = array
    while isinstance(seen, np.ndarray):
        if seen.flags.writeable:
            return True
        seen = seen.base
    return not (seen is None or isinstance(seen, bytes))


OLD_NAMES = {"pos": "q", "vel": "qd", "trq": "tau", "pos_o": "q_ref", "vel_o": "qd_ref", "trq_o": "tau_ref"}
OLD_NAMES |= {"timestamp": "t", "seqnum": "seq"}
"""Column name, keyed by field name in Robotlab.jl logs."""


def alias(name: str) -> str:
    """Return a column name with ``: . [ ]`` replaced by ``_`` and leading and trailing ``_`` removed, as in the
    predecessor software."""
    return re.sub(r"[:.\[\]]", "_", name).strip("_")


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Return a sorting key that compares digit groups as numbers."""
    pieces = re.findall(r"\d+|\D+", name)
    return [(0, int(piece), "") if piece.isdigit() else (1, 0, piece) for piece in pieces]


_LARGEST, _CELLS_PER_NUMBER = 1 << 31, 512  # bytes that are always allowed; maximum cells per value above that


def refuse_ragged(count: int, widths: Mapping[str, int], held: int) -> None:
    """Raise an error if padding ragged values would give large, nearly empty columns; `widths`: width by name."""
    cells = count * sum(widths.values())
    if 8 * cells > _LARGEST and cells > _CELLS_PER_NUMBER * held:
        widest = max(widths, key=lambda path: widths[path])
        raise LogError(
            f"Expected arrays of similar size, got {count} rows with {held} numbers, up to {widths[widest]} in "
            f"{widest[:80]}; padding the {len(widths)} column(s) would take {cells} cells."
        )


_RAD = np.pi / 180.0
UNITS = {
    "s": ("s", 1.0), "ms": ("s", 1e-3), "us": ("s", 1e-6), "ns": ("s", 1e-9), "rad": ("rad", 1.0), "deg": ("rad", _RAD),
    "m": ("m", 1.0), "mm": ("m", 1e-3), "rad/s": ("rad/s", 1.0), "deg/s": ("rad/s", _RAD),
    "rev/min": ("rad/s", np.pi / 30.0), "rpm": ("rad/s", np.pi / 30.0), "m/s": ("m/s", 1.0), "mm/s": ("m/s", 1e-3),
    "rad/s^2": ("rad/s^2", 1.0), "deg/s^2": ("rad/s^2", _RAD), "m/s^2": ("m/s^2", 1.0), "N": ("N", 1.0),
    "N m": ("N m", 1.0), "Nm": ("N m", 1.0), "N*m": ("N m", 1.0), "mN m": ("N m", 1e-3), "kg": ("kg", 1.0),
    "A": ("A", 1.0), "mA": ("A", 1e-3), "V": ("V", 1.0), "W": ("W", 1.0), "degC": ("degC", 1.0), "Hz": ("Hz", 1.0),
    "1": ("1", 1.0), "": ("", 1.0),
}  # fmt: skip
"""Unit in armlab and conversion factor, keyed by unit in a file."""


def between(kind: str, a: np.ndarray, b: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Interpolate between rows a and b at fractions s (k,); s = 0 returns a even if b is missing."""
    weight = s.reshape(-1, *[1] * (a.ndim - 1))
    exact = weight == 0
    if kind == "quaternion":
        whole = np.isfinite(a).all(axis=-1) & np.isfinite(b).all(axis=-1)
        found = np.full(a.shape, np.nan)
        found[whole] = quaternion.slerp(a[whole], b[whole], s[whole])
    elif kind == "pose":
        whole = np.isfinite(a).all(axis=(-2, -1)) & np.isfinite(b).all(axis=(-2, -1))
        found = np.full(a.shape, np.nan)
        found[whole] = pose_between(a[whole], b[whole], s[whole])
    else:
        found = (1.0 - weight) * a + weight * b
    return np.where(exact, a, found)


def pose_between(T_base_a: np.ndarray, T_base_b: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Interpolate poses: constant-rate rotation about a fixed axis, and linear translation."""
    R_a, R_b = T_base_a[:, :3, :3], T_base_b[:, :3, :3]
    turn = so3.log(R_a.swapaxes(-1, -2) @ R_b)
    p = (1.0 - s[:, None]) * T_base_a[:, :3, 3] + s[:, None] * T_base_b[:, :3, 3]
    return se3.from_rp(R_a @ so3.exp(s[:, None] * turn), p)


def holes(values: np.ndarray, missing: np.ndarray) -> np.ndarray:
    """Return the values with the masked rows (k,) set to missing (NaN or an empty string)."""
    if not missing.any():
        return values
    values = values.copy() if values.dtype.kind == "U" else values.astype(float)
    values[missing] = "" if values.dtype.kind == "U" else np.nan
    return values


def spread(values: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Return an array with the values in the masked rows and missing values elsewhere."""
    if inside.all():
        return values
    text = values.dtype.kind == "U"
    result = np.full((len(inside), *values.shape[1:]), "" if text else np.nan, dtype=values.dtype if text else float)
    result[inside] = values
    return result


def missing_rows(array: np.ndarray) -> np.ndarray:
    """Return the mask (N,) of rows with a NaN or, in text columns, an empty string."""
    if array.dtype.kind not in "fU" or not array.size:
        return np.zeros(len(array), dtype=bool)
    holes = np.isnan(array) if array.dtype.kind == "f" else np.asarray(array == "")
    return np.asarray(holes.reshape(len(array), -1).any(axis=1))
