"""Rows of a recording as bytes (specification; the compiled twin is native/row_packer.cpp)."""

from __future__ import annotations

from array import array
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from armlab.errors import ShapeError

__all__ = ["RowPacker"]

_FORMS = ("count", "real", "flag", "code", "doubles", "padded", "bits", "said", "heard")
_ARRAYS = ("doubles", "padded", "bits")
_SOURCES = ("state", "command", "tick", "record")


class RowPacker:
    """Packs what is known of a tick, attributes of three objects, into one row of bytes.

    Parameters
    ----------
    kinds : classes of the three objects, called "state", "command" and "tick" in `places`: dataclasses with slots or
        named tuples; an object of another class is asked for its attributes. A command may be None.
    places : of the columns in the row, one behind the other: (column, source, field, form, nothing, detail).
        source, field : object and attribute; source "record" is the value by this name in the attribute `record` of
        the command, else of the tick.
        form : "count" int64, "real" float64, "flag" one byte, "code" the number that the mapping `detail` gives a
        text, 0 for others; "doubles" exactly as many as fit, none or None for missing; "padded" at most as many as fit;
        "bits" exactly as many bytes as fit, None for missing; "said" one number or flag, None for missing; "heard" a
        flag that is missing when it is False and the column `detail` is missing.
        nothing : the bytes of a missing value; of "count", "real", "flag", "code" only their number counts.
    seldom : name of the first column of those at the end that a row leaves out when all of them are missing.
    """

    def __init__(self, kinds: tuple[type, type, type], places: Sequence[tuple[Any, ...]], seldom: str) -> None:
        known: dict[str, bytes] = {}
        for column, source, _, form, nothing, detail in places:
            if form not in _FORMS:
                raise ShapeError(f"Expected one of the forms {', '.join(_FORMS)} for {column}, got {form}.")
            fits = form in _ARRAYS or len(nothing) == (1 if form == "flag" else 8)
            if source not in _SOURCES or not fits or (form == "code" and not isinstance(detail, dict)):
                raise ShapeError(f"Expected a source, a size and codes that fit the form {form} for {column}.")
            if form == "heard" and detail not in known:
                raise ShapeError(f"Expected the column of data before {column}.")
            known[column] = nothing
        self._nothing = known
        self._places = tuple(places)
        self._seldom = next((i for i, place in enumerate(places) if place[0] == seldom), len(self._places))
        del kinds  # which attributes are slots is for the compiled twin

    def pack(self, state: Any, command: Any, tick: Any) -> bytes:
        """Return one row. Values are copied.

        Raises
        ------
        ShapeError : an array has the wrong number of values; names the column.
        AttributeError, TypeError, ValueError, OverflowError : an object or a value is none that can be packed.
        """
        sources = {"state": state, "command": command, "tick": tick}
        record = dict(tick.record)
        if command is not None:
            record |= {**command.record}
        parts: dict[str, bytes] = {}
        for column, source, field, form, nothing, detail in self._places:
            if source == "record":
                value = record.get(field)
            elif source == "command" and command is None:
                value = None
            else:
                value = getattr(sources[source], field)
            if form == "heard":
                heard = value or parts[detail] != self._nothing[detail]
                form, value = "said", bool(value) if heard else None
            parts[column] = _part(column, value, form, nothing, detail)
        row, nothing = list(parts.values()), list(self._nothing.values())
        ends = row[self._seldom :] == nothing[self._seldom :]
        return b"".join(row[: self._seldom] if ends else row)


def _part(column: str, value: Any, form: str, nothing: bytes, codes: Mapping[Any, int] | None) -> bytes:
    if form == "count":
        return array("q", [value]).tobytes()
    if form == "real":
        return array("d", [value]).tobytes()
    if form == "flag":
        return bytes([bool(value)])
    if form == "code":
        return array("q", [(codes or {}).get(value, 0)]).tobytes()
    if value is None:
        return nothing
    if form == "said":
        return array("d", [value]).tobytes()
    raw = np.asarray(value, dtype="u1" if form == "bits" else "<f8").tobytes()
    if form == "padded":
        return (raw + nothing[len(raw) :])[: len(nothing)]
    if form == "doubles" and not raw:
        return nothing
    if len(raw) != len(nothing):
        width = 1 if form == "bits" else 8
        raise ShapeError(f"Expected {len(nothing) // width} values in {column}, got {len(raw) // width}.")
    return raw
