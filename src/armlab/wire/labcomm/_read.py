"""Readers of values: one closure per node of a type, with `struct` formats compiled once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from operator import itemgetter
from struct import Struct as Format
from struct import unpack_from
from typing import Any

from armlab.errors import LabCommError
from armlab.wire.labcomm._shape import Shape, Size, checked_shape, nest
from armlab.wire.labcomm._source import Cut
from armlab.wire.labcomm.limits import Limits
from armlab.wire.labcomm.types import Array, Field, Prim, Struct, Type, containers

__all__ = ["Cursor", "Reader", "reader", "row_size", "runs"]


class Cursor:
    """Where a reader is in a packet that has come whole.

    Attributes
    ----------
    buf : bytes. at, end : next byte and end of the body, as indices of `buf`. base : position of ``buf[0]``.
    left : values that the packet may still hold. limits : of the stream.
    """

    __slots__ = ("at", "base", "buf", "end", "left", "limits", "wide")

    def __init__(self, buf: bytes | bytearray, limits: Limits, wide: bool) -> None:
        self.buf, self.limits, self.wide = buf, limits, wide
        self.at = self.end = self.base = self.left = 0

    def number(self) -> int:
        """Read a size or a length."""
        first, buf = self.at, self.buf
        if self.wide:
            self.at += 4
            if self.at > self.end:
                raise Cut
            return int.from_bytes(buf[first : self.at], "big")
        value = 0
        for at in range(first, first + 5):
            if at >= self.end:
                raise Cut
            byte = buf[at]
            value = value << 7 | byte & 0x7F
            if byte < 0x80:
                if value >= 2**32:
                    break
                self.at = at + 1
                return value
        offset = self.base + first
        raise LabCommError(f"Expected a number below 2**32 in at most 5 bytes at byte {offset}, got more.", offset)

    def shape(self, node: Array) -> Shape:
        """Read the variable sizes of an array and check them."""
        read = []
        for size in node.dims:
            if not size:
                where = self.base + self.at
                read.append(Size(self.number(), where))
        shape = checked_shape(node, read, self.end - self.at, self.wide, self.limits)
        if shape.last is not None:
            self.left -= containers(shape.sizes) - 1 + shape.total * node.elem.values
            if self.left < 0:
                limit = self.limits.values
                raise LabCommError(
                    f"Expected at most {limit} values in a packet, got more in the array at byte {shape.last}.",
                    shape.last,
                )
        return shape


Reader = Callable[[Cursor], Any]


def reader(node: Type) -> Reader:
    """Return what reads a value of a type. It raises `Cut` or LabCommError."""
    if isinstance(node, Prim):
        return _prim(node) if node.letter else _string
    if isinstance(node, Array):
        return _array(node)
    if isinstance(node, Struct):
        return _struct(node)
    raise LabCommError(f"Expected a type whose values can be read, got a reference to type {node.index}.")


def runs(node: Struct) -> list[list[Field]]:
    """Return the fields of a struct in order, those together that one `struct` call takes."""
    found: list[list[Field]] = []
    was_flat = False
    for field in node.fields:
        is_flat = row_size(field.type) is not None
        if is_flat and was_flat:
            found[-1].append(field)
        else:
            found.append([field])
        was_flat = is_flat
    return found


def row_size(node: Type) -> int | None:
    """Return how many numbers a fixed row has, -1 for a scalar; None of what is not numbers alone."""
    size = -1
    if isinstance(node, Array) and len(node.dims) == 1 and node.dims[0]:
        size, node = node.dims[0], node.elem
    return size if isinstance(node, Prim) and node.letter not in ("", "?", "B") else None


def decoded(raw: bytes) -> str:
    """Return the text of a string on the wire: UTF-8, else Java's modified UTF-8, else with escaped bytes."""
    try:
        return raw.decode()
    except UnicodeDecodeError:
        pass
    try:
        pairs = raw.replace(b"\xc0\x80", b"\0").decode("utf-8", "surrogatepass")
        return pairs.encode("utf-16-le", "surrogatepass").decode("utf-16-le")
    except UnicodeDecodeError:
        return raw.decode("utf-8", "surrogateescape")


def _string(cursor: Cursor) -> str:
    where = cursor.base + cursor.at
    size = cursor.number()
    start, stop = cursor.at, cursor.at + size
    if stop > cursor.end:
        left = cursor.end - start
        raise LabCommError(f"Expected a string of at most {left} bytes at byte {where}, got {size}.", where)
    cursor.at = stop
    return decoded(bytes(cursor.buf[start:stop]))


def _prim(node: Prim) -> Reader:
    unpack, size = Format(">" + node.letter).unpack_from, node.size

    def read(cursor: Cursor) -> Any:
        start = cursor.at
        cursor.at = start + size
        if cursor.at > cursor.end:
            raise Cut
        return unpack(cursor.buf, start)[0]

    return read


def _flat(fields: Sequence[Field]) -> Reader:
    """One `struct` call for all; a slice or an index of its result per field."""
    node = Struct(tuple(fields))
    unpack, size = Format(node.struct_format or "").unpack_from, node.size
    names, places, at = [field.name for field in fields], [], 0
    for field in fields:
        count = row_size(field.type) or 0
        places.append(at if count < 0 else slice(at, at + count))
        at += abs(count)
    pick = itemgetter(*places)

    def read(cursor: Cursor) -> dict[str, Any]:
        start = cursor.at
        cursor.at = start + size
        if cursor.at > cursor.end:
            raise Cut
        return dict(zip(names, pick(list(unpack(cursor.buf, start))), strict=True))

    return read


def _struct(node: Struct) -> Reader:
    parts = [(None, _flat(run)) if len(run) > 1 else (run[0].name, reader(run[0].type)) for run in runs(node)]
    if len(parts) == 1 and parts[0][0] is None:
        return parts[0][1]

    def read(cursor: Cursor) -> dict[str, Any]:
        value: dict[str, Any] = {}
        for name, part in parts:
            if name is None:
                value.update(part(cursor))
            else:
                value[name] = part(cursor)
        return value

    return read


def _array(node: Array) -> Reader:
    elem = node.elem
    if isinstance(elem, Prim) and elem.letter:
        return _numbers(node, elem)
    part = reader(elem)

    def read(cursor: Cursor) -> list[Any]:
        shape = cursor.shape(node)
        return nest([part(cursor) for _ in range(shape.total)], shape.sizes)

    return read


def _numbers(node: Array, elem: Prim) -> Reader:
    size, letter = elem.size, elem.letter
    is_bytes = letter == "B" and len(node.dims) == 1

    def read(cursor: Cursor) -> Any:
        shape = cursor.shape(node)
        start, stop = cursor.at, cursor.at + shape.total * size
        if stop > cursor.end:
            raise Cut
        cursor.at = stop
        if is_bytes:
            return bytes(cursor.buf[start:stop])
        flat = list(unpack_from(f">{shape.total}{letter}", cursor.buf, start))
        return nest(flat, shape.sizes) if len(shape.sizes) > 1 else flat

    return read
