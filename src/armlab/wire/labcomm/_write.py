"""Writers of values: one closure per node of a type. A wrong value leaves as `Misfit` with the path to it."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence
from struct import Struct as Format
from typing import Any, NamedTuple

from armlab.errors import LabCommError
from armlab.wire.labcomm._read import row_size, runs
from armlab.wire.labcomm.dialects import Dialect
from armlab.wire.labcomm.types import SAMPLE, Array, Field, Prim, SampleType, Struct, Type, typename

__all__ = ["Misfit", "Wire", "Writer", "writer"]

Writer = Callable[[Any], bytes]


class Misfit(Exception):
    """A value does not fit its type: what is wrong, and the path from the innermost part outwards."""

    def __init__(self, text: str, *path: str) -> None:
        super().__init__(text)
        self.text, self.path = text, list(path)


class Wire(NamedTuple):
    """How values are written: dialect, whether strings may hold NUL, and the index of a sample type referred to."""

    dialect: Dialect
    allow_nul: bool
    index_of: Callable[[SampleType], int]


def writer(node: Type, wire: Wire) -> Writer:
    """Return what writes a value of a type."""
    if isinstance(node, Prim):
        return _prim(node, wire)
    if isinstance(node, Array):
        return _array(node, wire)
    if isinstance(node, Struct):
        return _struct(node, wire)
    raise LabCommError(f"Expected a type whose values can be written, got a reference to type {node.index}.")


def _prim(node: Prim, wire: Wire) -> Writer:
    if not node.letter:
        return lambda value: _text(value, wire)
    pack, name = Format(">" + node.letter).pack, node.name

    def write(value: Any) -> bytes:
        if node.code == SAMPLE and isinstance(value, SampleType):
            value = wire.index_of(value)
        if name == "boolean" and not _is_boolean(value):
            raise Misfit(f"True or False expected, {value!r} given")
        try:
            return pack(value)
        except (struct.error, TypeError, ValueError, OverflowError):
            raise Misfit(f"a {name} expected, {value!r} given") from None

    return write


def _is_boolean(value: Any) -> bool:
    return (isinstance(value, int) and value in (0, 1)) or type(value).__name__ in ("bool", "bool_")


def _text(value: Any, wire: Wire) -> bytes:
    if not isinstance(value, str):
        raise Misfit(f"a string expected, {value!r} given")
    if "\0" in value and not wire.allow_nul:
        raise Misfit("a string without NUL expected, which would end it in C")
    try:
        return wire.dialect.text(value.encode("utf-8", "surrogateescape"))
    except UnicodeEncodeError:
        raise Misfit(f"a string that UTF-8 can write expected, {value!r} given") from None


def _struct(node: Struct, wire: Wire) -> Writer:
    parts = [_flat(run, wire) if len(run) > 1 else _field(run[0], wire) for run in runs(node)]
    count = len(node.fields)

    def write(value: Any) -> bytes:
        try:
            if len(value) == count:
                return b"".join([part(value) for part in parts])
        except (TypeError, LookupError):
            pass
        raise _unlike(value, [field.name for field in node.fields])

    return write


def _flat(fields: Sequence[Field], wire: Wire) -> Writer:
    """One `struct` call for all these fields of a value; whatever is odd goes one by one, which says what is wrong."""
    pack = Format(Struct(tuple(fields)).struct_format or "").pack
    counts = [(field.name, row_size(field.type) or 0) for field in fields]
    one_by_one = [_field(field, wire) for field in fields]

    def write(value: Any) -> bytes:
        flat: list[Any] = []
        try:
            for name, count in counts:
                part = value[name]
                if count < 0:
                    flat.append(part)
                    continue
                if type(part) is not list and type(part) is not tuple:
                    part = part.tolist()
                if len(part) != count:
                    break
                flat += part
            else:
                return pack(*flat)
        except (struct.error, TypeError, ValueError, OverflowError, AttributeError):
            pass
        return b"".join([part(value) for part in one_by_one])

    return write


def _field(field: Field, wire: Wire) -> Writer:
    """One field of a value."""
    name, part = field.name, writer(field.type, wire)

    def write(value: Any) -> bytes:
        try:
            return part(value[name])
        except Misfit as error:
            error.path.append(f".{name}")
            raise

    return write


def _unlike(value: Any, names: Sequence[str]) -> Misfit:
    """Return what is wrong with a value that has not the fields of its struct."""
    if not isinstance(value, Mapping):
        return Misfit(f"a dict expected, {value!r} given")
    missing, extra = sorted(set(names) - value.keys()), sorted(map(str, value.keys() - set(names)))
    given = f"{', '.join(missing)} missing" if missing else f"{', '.join(extra)} given"
    return Misfit(f"the fields {', '.join(names) or '(none)'} expected, {given}")


def _array(node: Array, wire: Wire) -> Writer:
    elem, dims, number = node.elem, node.dims, wire.dialect.number
    letter = elem.letter if isinstance(elem, Prim) and elem.name not in ("boolean", "sample") else ""
    part = writer(elem, wire)

    def write(value: Any) -> bytes:
        flat, sizes = _flattened(value, node)
        head = b"".join(number(size) for size, fixed in zip(sizes, dims, strict=True) if not fixed)
        if letter:
            try:
                return head + struct.pack(f">{len(flat)}{letter}", *flat)
            except (struct.error, TypeError, ValueError, OverflowError):
                pass  # the way through each element says which
        parts = [head]
        for index, one in enumerate(flat):
            try:
                parts.append(part(one))
            except Misfit as error:
                error.path.append(_place(index, sizes))
                raise
        return b"".join(parts)

    return write


def _flattened(value: Any, node: Array) -> tuple[Sequence[Any], list[int]]:
    """Return the elements in order and the sizes; a list that is not rectangular is refused."""
    dims = node.dims
    shape = getattr(value, "shape", None)
    if shape is not None and len(shape) == len(dims) and callable(getattr(value, "reshape", None)):
        sizes, flat = list(shape), value.reshape(-1).tolist()
        _check(sizes, dims)
        return flat, sizes
    if len(dims) == 1:
        row = _row(value, node, "")
        _check([len(row)], dims)
        return row, [len(row)]
    flat, sizes, path = [value], [], ""
    for level, fixed in enumerate(dims):
        rows = [_row(one, node, path) for one in flat]
        size = len(rows[0]) if rows else fixed
        if any(len(row) != size for row in rows):
            given = sorted({len(row) for row in rows})
            raise Misfit(f"rows of one length expected, {' and '.join(map(str, given))} given")
        sizes.append(size)
        _check(sizes, dims[: level + 1])
        flat = rows[0] if len(rows) == 1 else [one for row in rows for one in row]
        path += "[]"
    return flat, sizes


def _row(value: Any, node: Array, path: str) -> Sequence[Any]:
    if isinstance(value, list | tuple | bytes | bytearray | range):
        return value
    listed = value.tolist() if callable(getattr(value, "tolist", None)) else None
    if isinstance(listed, list):
        return listed
    raise Misfit(f"a list for {typename(node)}{path} expected, {value!r} given")


def _check(sizes: Sequence[int], dims: Sequence[int]) -> None:
    for size, fixed in zip(sizes, dims, strict=True):
        if fixed and size != fixed:
            raise Misfit(f"{fixed} values expected, {size} given")


def _place(index: int, sizes: Sequence[int]) -> str:
    places = []
    for size in reversed(sizes):
        index, place = divmod(index, size)
        places.append(f"[{place}]")
    return "".join(reversed(places))
