"""Walks over definitions and over values whose end only decoding finds."""

from __future__ import annotations

from collections.abc import Generator
from typing import NamedTuple

from armlab.errors import LabCommError
from armlab.wire.labcomm._shape import Size, checked_shape
from armlab.wire.labcomm._source import Cut, Source, label, number
from armlab.wire.labcomm.dialects import Dialect, Notes
from armlab.wire.labcomm.limits import Limits
from armlab.wire.labcomm.signature import FIRST_INDEX, SignatureWalk
from armlab.wire.labcomm.types import Array, Struct, Type


class Head(NamedTuple):
    """What a definition packet says."""

    index: int  # pyright: ignore[reportIncompatibleMethodOverride]
    name: str
    notes: Notes
    type: Type
    end: int


def definition(
    source: Source, pos: int, end: int, dialect: Dialect, limits: Limits, type_refs: bool
) -> Generator[None, None, Head]:
    """Walk over the body of a SAMPLE_DEF, SAMPLE_REF or TYPE_DEF; `Cut` leaves it when the body is too short."""
    first = pos
    index, pos = yield from number(source, pos, end, dialect.wide)
    if index < FIRST_INDEX:
        raise _bad(first, f"an index from {FIRST_INDEX:#x} on", f"{index:#x}")
    name, notes, pos = yield from label(source, pos, end, dialect, limits)
    if not dialect.lengths:
        tree, pos = yield from SignatureWalk(source, dialect, limits, end, type_refs).tree(pos)
        return Head(index, name, notes, tree, pos)
    declared = pos
    size, pos = yield from number(source, pos, end, dialect.wide)
    if pos + size != end:
        raise _bad(declared, f"a signature of the {end - pos} bytes left in the packet", f"a length of {size}")
    try:
        tree, pos = yield from SignatureWalk(source, dialect, limits, end, type_refs).tree(pos)
    except Cut:
        raise _bad(declared, f"a signature of {size} bytes that is a whole type", "one that goes on") from None
    if pos != end:
        raise _bad(declared, f"a signature of {size} bytes", f"one that ends {end - pos} bytes before")
    return Head(index, name, notes, tree, pos)


def value_end(source: Source, node: Type, pos: int, end: int, wide: bool, limits: Limits) -> Generator[None, None, int]:
    """Walk over a value to its end; `Cut` leaves it when the body would be too long."""
    if node.fixed_size is not None:
        pos += node.fixed_size
    elif isinstance(node, Struct):
        for field in node.fields:
            pos = yield from value_end(source, field.type, pos, end, wide, limits)
    elif isinstance(node, Array):
        read: list[Size] = []
        for size in node.dims:
            if not size:
                where = pos
                size, pos = yield from number(source, pos, end, wide)
                read.append(Size(size, where))
        shape = checked_shape(node, read, end - pos, wide, limits)
        if node.elem.fixed_size is not None:
            pos += shape.total * node.elem.fixed_size
        else:
            for _ in range(shape.total):
                pos = yield from value_end(source, node.elem, pos, end, wide, limits)
    else:
        where = pos
        size, pos = yield from number(source, pos, end, wide)
        if pos + size > end:
            raise _bad(where, "a string that ends in its packet", f"{size} bytes")
        pos += size
    if pos > end:
        raise Cut
    return pos


def _bad(offset: int, expected: str, got: str) -> LabCommError:
    return LabCommError(f"Expected {expected} at byte {offset}, got {got}.", offset)
