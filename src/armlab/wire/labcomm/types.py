"""LabComm types (as immutable trees), dialects, and the packets of a stream (as events)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

from armlab.errors import LabCommError, UnknownName

Notes = tuple[tuple[str, str], ...]


@dataclass(frozen=True, slots=True)
class Dialect:
    """Version of the LabComm format."""

    name: str
    version: str  # announced text, "" for none
    lengths: bool = True  # whether packets contain the length of their body
    trusted: bool = True  # whether this length is correct
    wide: bool = False  # whether numbers have 4 bytes instead of packed32
    maps: bool = False  # whether names are maps of strings (intentions)
    references: bool = True  # whether samples may refer to sample types

    def number(self, n: int) -> bytes:
        """Encode a number in its shortest form (300 is 82 2c) or in 4 bytes."""
        if not 0 <= n < 2**32:
            raise LabCommError(f"Expected a number from 0 to {2**32 - 1}, got {n}.")
        if self.wide:
            return n.to_bytes(4, "big")
        groups = [n & 0x7F]
        while n := n >> 7:
            groups.append(n & 0x7F | 0x80)
        return bytes(reversed(groups))

    def text(self, raw: bytes) -> bytes:
        """Encode a string as its length in bytes followed by the bytes."""
        return self.number(len(raw)) + raw

    def label(self, name: str, notes: Notes = ()) -> bytes:
        """Encode a name, with its notes (pairs of key and value) if the dialect supports them."""
        try:
            if not self.maps:
                return self.text(name.encode())
            entries = [("", name), *sorted(notes)]
            return self.number(len(entries)) + b"".join(self.text(part.encode()) for entry in entries for part in entry)
        except UnicodeEncodeError:
            raise LabCommError(f"Expected a name encodable in UTF-8, got {name!r}.") from None

    def packet(self, tag: int, body: bytes, length: int | None = None) -> bytes:
        """Encode a packet; `length` overrides the declared length."""
        if not self.lengths:
            return self.number(tag) + body
        return self.number(tag) + self.number(len(body) if length is None else length) + body


DIALECTS = {
    dialect.name: dialect
    for dialect in (
        Dialect("2014v1", "LabComm2014.v1"),
        Dialect("2014", "LabComm2014"),
        Dialect("2014i", "LabComm2014", maps=True),
        Dialect("2014old", "LabComm2014", trusted=False, references=False),
        Dialect("2013", "LabComm2013", lengths=False, references=False),
        Dialect("2006", "", lengths=False, wide=True, references=False),
    )
}
"""All dialects by name."""


def dialect_named(name: str) -> Dialect:
    if name not in DIALECTS:
        raise UnknownName.among("LabComm dialect", name, DIALECTS)
    return DIALECTS[name]


ARRAY, STRUCT, STRING, SAMPLE = 0x10, 0x11, 0x27, 0x28
_CODES = {
    "boolean": (0x20, "?", 1),
    "byte": (0x21, "B", 1),
    "short": (0x22, "h", 2),
    "int": (0x23, "i", 4),
    "long": (0x24, "q", 8),
    "float": (0x25, "f", 4),
    "double": (0x26, "d", 8),
    "string": (STRING, "", 0),
    "sample": (SAMPLE, "i", 4),
}
_MAX_DEPTH, _MAX_DIMS, _NUMBERS = 32, 16, 2**32


def _set(node: object, **values: object) -> None:
    for name, value in values.items():
        object.__setattr__(node, name, value)


def _check_part(node: _Node, what: str) -> None:
    if node.nodes == 1 and not node.size + node.numbers:
        raise LabCommError(f"Expected a non-void type for {what}, got void, which is allowed only for a whole sample.")
    if node.depth >= _MAX_DEPTH:
        raise LabCommError(f"Expected at most {_MAX_DEPTH} levels in a type, got more in {what}.")


@dataclass(frozen=True, slots=True)
class _Node:
    """Common properties of types: counts of fixed bytes, variable-size numbers, levels, nodes and values."""

    size: int = field(init=False, compare=False, repr=False, default=0)
    numbers: int = field(init=False, compare=False, repr=False, default=1)
    depth: int = field(init=False, compare=False, repr=False, default=1)
    nodes: int = field(init=False, compare=False, repr=False, default=1)
    values: int = field(init=False, compare=False, repr=False, default=1)

    @property
    def fixed_size(self) -> int | None:
        """Size of each value in bytes, or None if it varies."""
        return None if self.numbers else self.size

    def min_size(self, wide: bool) -> int:
        """Return the minimum encoded size of a value in bytes; with `wide`, each number takes 4 bytes."""
        return self.size + self.numbers * (4 if wide else 1)

    def signature(self, dialect: str = "2014v1") -> bytes:
        """Return the flat signature in a dialect."""
        return b"".join(_signature(self, dialect))


@dataclass(frozen=True, slots=True)
class Prim(_Node):
    """Primitive type; `name` is one of boolean, byte, short, int, long, float, double, string, sample (a reference)."""

    name: str
    code: int = field(init=False, compare=False, repr=False)  # on the wire
    letter: str = field(init=False, compare=False, repr=False)  # format character of `struct`, "" for a string

    def __post_init__(self) -> None:
        if self.name not in _CODES:
            raise LabCommError(f"Expected a primitive type ({', '.join(_CODES)}), got {self.name!r}.")
        code, letter, size = _CODES[self.name]
        _set(self, code=code, letter=letter, size=size, numbers=int(self.name == "string"))


@dataclass(frozen=True, slots=True)
class TypeRef(_Node):
    """Reference to a type by its index; occurs only in the signature of a TYPE_DEF."""

    index: int


@dataclass(frozen=True, slots=True)
class Array(_Node):
    """Rectangular array."""

    dims: tuple[int, ...]  # size of each dimension, 0 if variable
    elem: Type

    def __post_init__(self) -> None:
        dims, elem = tuple(self.dims), self.elem
        if not 1 <= len(dims) <= _MAX_DIMS or not all(0 <= size < _NUMBERS for size in dims):
            raise LabCommError(f"Expected 1 to {_MAX_DIMS} sizes from 0 (variable) to 2**32 - 1, got {dims}.")
        _check_part(elem, "an element of an array")
        variable, count = dims.count(0), math.prod(dims)
        _set(
            self,
            dims=dims,
            size=count * elem.size,
            numbers=variable or count * elem.numbers,
            depth=elem.depth + 1,
            nodes=elem.nodes + 1,
            values=1 if variable else containers(dims) + count * elem.values,
        )


class Field(NamedTuple):
    """Field of a struct: name, type, and notes (pairs of key and value, dialect 2014i only)."""

    name: str
    type: Type
    notes: Notes = ()


@dataclass(frozen=True, slots=True)
class Struct(_Node):
    """Named fields in order; the type `VOID` has no fields."""

    fields: tuple[Field, ...]

    def __post_init__(self) -> None:
        fields = tuple(Field(*entry) for entry in self.fields)
        names = [entry.name for entry in fields]
        if len(set(names)) < len(names):
            raise LabCommError(f"Expected distinct field names in a struct, got {', '.join(names)}.")
        for entry in fields:
            _check_part(entry.type, f"the field {entry.name}")
        types = [entry.type for entry in fields]
        _set(
            self,
            fields=fields,
            size=sum(one.size for one in types),
            numbers=sum(one.numbers for one in types),
            depth=1 + max((one.depth for one in types), default=0),
            nodes=1 + sum(one.nodes for one in types),
            values=1 + sum(one.values for one in types),
        )


Type = Prim | Array | Struct | TypeRef
"""Type tree."""

PRIMS = {name: Prim(name) for name in _CODES}
"""Primitive types by name."""

VOID = Struct(())
"""Type of a sample without a value."""


class SampleType(NamedTuple):
    """Named type, defined by a SAMPLE_DEF."""

    name: str
    type: Type
    notes: Notes = ()  # pairs of key and value outside the signature


def typename(node: Type) -> str:
    """Return the name of a type for error messages, such as "double[7]" or "struct"."""
    if isinstance(node, Array):
        return f"{typename(node.elem)}[{','.join(str(size or '_') for size in node.dims)}]"
    return node.name if isinstance(node, Prim) else f"type {node.index}" if isinstance(node, TypeRef) else "struct"


def containers(shape: tuple[int, ...]) -> int:
    """Return the number of lists in a nested list of this shape."""
    total = rows = 1
    for size in shape[:-1]:
        rows *= size
        total += rows
    return total


def _signature(node: _Node, name: str) -> Iterator[bytes]:
    dialect = dialect_named(name)
    if isinstance(node, Prim):
        if node.code == SAMPLE and not dialect.references:
            raise LabCommError(f"Expected a type of LabComm {name}, got a reference to a sample.")
        yield dialect.number(node.code)
    elif isinstance(node, TypeRef):
        yield dialect.number(node.index)
    elif isinstance(node, Array):
        yield b"".join(map(dialect.number, (ARRAY, len(node.dims), *node.dims)))
        yield from _signature(node.elem, name)
    elif isinstance(node, Struct):
        yield dialect.number(STRUCT) + dialect.number(len(node.fields))
        for entry in node.fields:
            yield dialect.label(entry.name, entry.notes)
            yield from _signature(entry.type, name)


Kind = Literal["sample", "ref", "type"]


class Version(NamedTuple):
    """VERSION packet with the announced text."""

    text: str


class Definition(NamedTuple):
    """SAMPLE_DEF, SAMPLE_REF or TYPE_DEF packet."""

    kind: Kind
    index: int  # pyright: ignore[reportIncompatibleMethodOverride]
    name: str
    type: Type
    notes: Notes = ()  # of the name, in dialect 2014i only


class Binding(NamedTuple):
    """TYPE_BINDING packet: index of a sample and of its type (0: its flat signature)."""

    sample: int
    type: int


class Pragma(NamedTuple):
    """PRAGMA packet."""

    kind: str
    body: bytes


class Other(NamedTuple):
    """Skipped packet with a reserved tag."""

    tag: int
    body: bytes


class Sample(NamedTuple):
    """Value of a sample.

    Attributes
    ----------
    index : index of the sample.
    name : name of the sample.
    value : bool, int, float, str, bytes, nested lists, or a dict in the order of the fields.
    type : type of the value.
    """

    index: int  # pyright: ignore[reportIncompatibleMethodOverride]
    name: str
    value: Any
    type: Type


class Unknown(NamedTuple):
    """Skipped data with an undefined index."""

    index: int  # pyright: ignore[reportIncompatibleMethodOverride]
    body: bytes


Event = Version | Definition | Binding | Pragma | Other | Sample | Unknown
"""Packet of a stream."""
