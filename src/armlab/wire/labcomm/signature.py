"""Flat signatures: `parse_signature`, and the walk over the signature of a stream."""

from __future__ import annotations

from collections.abc import Generator

from armlab.errors import LabCommError
from armlab.wire.labcomm.dialects import Dialect, dialect_named
from armlab.wire.labcomm.source import Cut, Limits, Number, Source, label, number
from armlab.wire.labcomm.types import ARRAY, PRIMS, SAMPLE, STRUCT, VOID, Array, Field, Struct, Type, TypeRef

FIRST_INDEX = 0x40
"""Smallest index of a sample or type; smaller numbers are tags and type codes."""

_BY_CODE = {prim.code: prim for prim in PRIMS.values()}


def parse_signature(data: bytes, dialect: str = "2014v1", limits: Limits | None = None) -> Type:
    """Return the type of a flat signature; ``parse_signature(t.signature()) == t``.

    Parameters
    ----------
    data : the signature. dialect : that wrote it. limits : `Limits.file()` by default.

    Raises
    ------
    LabCommError : the signature is malformed; `offset` counts from its first byte. UnknownName : no such dialect.
    """
    source = Source()
    source.add(data)
    walk = SignatureWalk(source, dialect_named(dialect), limits or Limits.file(), len(data))
    try:
        next(walk.tree(0))
    except StopIteration as done:
        tree, pos = done.value
        if pos == len(data):
            return tree
        raise _bad(pos, "the end of the signature", f"{len(data) - pos} more bytes") from None
    except Cut:
        pass
    raise _bad(len(data), "the rest of the signature", "its end")


class SignatureWalk:
    """Walks over one signature.

    `end`: where the signature ends at the latest; `type_refs`: indices of types may stand for types (TYPE_DEF).
    """

    def __init__(self, source: Source, dialect: Dialect, limits: Limits, end: int, type_refs: bool = False) -> None:
        self.source, self.dialect, self.limits, self.end, self.type_refs = source, dialect, limits, end, type_refs
        self.nodes = 0

    def number(self, pos: int) -> Number:
        """Walk over a number."""
        return number(self.source, pos, self.end, self.dialect.wide)

    def tree(self, first: int, depth: int = 1) -> Generator[None, None, tuple[Type, int]]:
        """Walk over one node and what is below it."""
        code, pos = yield from self.number(first)
        self.nodes += 1
        if depth > self.limits.depth or self.nodes > self.limits.values:
            raise _bad(first, f"at most {self.limits.depth} levels and {self.limits.values} nodes", "more")
        node: Type
        if code == ARRAY:
            node, pos = yield from self._array(pos, depth)
        elif code == STRUCT:
            node, pos = yield from self._struct(first, pos, depth)
        elif code in _BY_CODE and (code != SAMPLE or self.dialect.references):
            return _BY_CODE[code], pos
        elif code >= FIRST_INDEX and self.type_refs:
            return TypeRef(code), pos
        else:
            raise _bad(first, "a type code", f"{code:#x}")
        size = node.min_size(self.dialect.name)
        if size > self.limits.packet or node.values > self.limits.values:
            limits = f"a type of at most {self.limits.packet} bytes and {self.limits.values} values"
            raise _bad(first, limits, f"{size} bytes and {node.values} values")
        return node, pos

    def _array(self, pos: int, depth: int) -> Generator[None, None, tuple[Type, int]]:
        count, after = yield from self.number(pos)
        if not 1 <= count <= self.limits.dims:
            raise _bad(pos, f"an array of 1 to {self.limits.dims} dimensions", str(count))
        dims, product = [], 1
        for _ in range(count):
            pos = after
            size, after = yield from self.number(pos)
            product *= size or 1
            if product > self.limits.values:
                raise _bad(pos, f"sizes whose product is at most {self.limits.values}", str(product))
            dims.append(size)
        elem, pos = yield from self._part(after, depth)
        return Array(tuple(dims), elem), pos

    def _struct(self, first: int, pos: int, depth: int) -> Generator[None, None, tuple[Type, int]]:
        count, pos = yield from self.number(pos)
        if count > self.limits.values:
            raise _bad(first, f"at most {self.limits.values} nodes", f"{count} fields")
        if not count:
            return VOID, pos
        fields: dict[str, Field] = {}
        for _ in range(count):
            where = pos
            name, notes, pos = yield from label(self.source, pos, self.end, self.dialect, self.limits)
            if name in fields:
                raise _bad(where, "different names for the fields of a struct", f"{name!r} again")
            part, pos = yield from self._part(pos, depth)
            fields[name] = Field(name, part, notes)
        return Struct(tuple(fields.values())), pos

    def _part(self, first: int, depth: int) -> Generator[None, None, tuple[Type, int]]:
        node, pos = yield from self.tree(first, depth + 1)
        if node == VOID:
            raise _bad(first, "a type with a value inside an array or struct", "void")
        return node, pos


def _bad(offset: int, expected: str, got: str) -> LabCommError:
    return LabCommError(f"Expected {expected} at byte {offset}, got {got}.", offset)
