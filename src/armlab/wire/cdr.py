"""Layout of CDR messages, used to read and modify numbers in ROS 2 messages without creating objects."""

from __future__ import annotations

import struct
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from armlab.errors import LogError

__all__ = ["Field", "Layout", "NO_MEMBER", "bounded", "definitions", "held", "layout", "with_bytes"]

_SIZES = {
    "bool": ("b1", 1),
    "byte": ("u1", 1),
    "char": ("u1", 1),
    "octet": ("u1", 1),
    "int8": ("i1", 1),
    "uint8": ("u1", 1),
    "int16": ("i2", 2),
    "uint16": ("u2", 2),
    "int32": ("i4", 4),
    "uint32": ("u4", 4),
    "int64": ("i8", 8),
    "uint64": ("u8", 8),
    "float32": ("f4", 4),
    "float64": ("f8", 8),
}
_HEADER = 4  # bytes of encapsulation (CDR kind and byte order); alignment is relative to their end
_MAX_DEPTH = 32
_MAX_FIELDS = 100_000  # maximum number of fields of a type, including nested types
_MAX_NAME = 1000
_EMPTY = 64  # fields allowed in addition to the limit per byte
_PER_BYTE = 16  # maximum number of fields per byte; nested messages may add fields without bytes
_LETTERS = 16  # characters of a name that count as one field
NO_MEMBER = "structure_needs_at_least_one_member"  # dummy byte in ROS 2

_BYTE = (1, ("uint8", 0))
Definitions = Mapping[str, list[tuple[str, Any]]]


@dataclass(frozen=True, slots=True)
class Field:
    """Contiguous numbers in a message."""

    path: str  # for example "pose.position.x"
    start: int  # from the beginning of the message, including the encapsulation [bytes]
    stop: int
    dtype: str  # NumPy type with byte order
    count: int
    scalar: bool  # False for arrays and sequences


@dataclass(frozen=True, slots=True)
class Layout:
    """Byte positions of the numbers in one message, and the message's strings."""

    fields: tuple[Field, ...]  # in message order, including empty sequences
    texts: Mapping[str, str | tuple[str, ...]]  # strings and tuples of strings by dotted name

    def field(self, path: str) -> Field | None:
        """Return the field with this dotted name, or None."""
        return next((field for field in self.fields if field.path == path), None)


@lru_cache(maxsize=64)
def definitions(name: str, text: str, encoding: str = "ros2msg") -> Definitions:
    """Return the fields of a message type and its nested types, parsed from its schema text."""
    from rosbags.typesys import TypesysError, get_types_from_idl, get_types_from_msg

    if encoding not in ("ros2msg", "ros2idl"):
        raise LogError(f"Expected a definition of {name} in ros2msg or ros2idl, got the encoding {encoding!r}.")
    try:
        types = get_types_from_msg(text, name) if encoding == "ros2msg" else get_types_from_idl(text)
    except (TypesysError, ValueError, KeyError, RecursionError) as error:
        reason = textwrap.shorten(str(error), 120)  # the error repeats the whole text
        raise LogError(f"Expected a {encoding} definition of {name}, got invalid text: {reason}.") from None
    return bounded(name, with_bytes({typename: entry[1] for typename, entry in types.items()}))


def with_bytes(types: Definitions) -> Definitions:
    """Return the definitions with the dummy byte that ROS 2 adds to messages without fields."""
    return {name: fields or [(NO_MEMBER, _BYTE)] for name, fields in types.items()}


@dataclass(frozen=True, slots=True)
class _Size:
    """Size of a type including nested types; `least` and `walked` are the numbers of bytes and fields when all
    sequences are empty."""

    fields: int = 0
    depth: int = 0
    longest: int = 0
    least: int = 0
    walked: int = 0


def bounded(name: str, types: Definitions) -> Definitions:
    """Return the definitions unchanged; raise an error if nesting makes the type exponentially large."""
    known: dict[str, _Size] = {}

    def size(one: str, depth: int) -> _Size:
        if one in known:
            return known[one]
        if depth > _MAX_DEPTH:
            raise LogError(
                f"Expected message types nested at most {_MAX_DEPTH} levels deep, got more levels in {one[:80]}."
            )
        if one not in types:
            raise LogError(
                f"Expected the definition of {one[:80]} in the definition of {name[:80]}, but it is missing."
            )
        found = _Size(fields=1, walked=1)
        for field, description in types[one]:
            element, count, is_sequence = held(description)
            inner = size(element, depth + 1) if element else _Size(fields=1, least=1, walked=1)
            if count < 0:
                raise LogError(f"Expected {field[:80]} of {one[:80]} to have a length of at least 0, got {count}.")
            if is_sequence and inner.walked > _PER_BYTE * inner.least:
                raise LogError(
                    f"Expected at most {_PER_BYTE} fields per byte in the elements of {field[:80]} of {one[:80]}, got "
                    f"{inner.walked} fields in {inner.least} bytes."
                )
            found = _Size(
                found.fields + (max(count, 1) * inner.fields if element else 1),
                max(found.depth, inner.depth + bool(element)),
                max(found.longest, len(field) + 1 + inner.longest),
                found.least + (1 if is_sequence else count * inner.least),
                found.walked + (1 if is_sequence or not element else 1 + count * inner.walked),
            )
        _refuse_large(one, found)
        known[one] = found
        return found

    size(name, 0)
    return types


def _refuse_large(name: str, size: _Size) -> None:
    most = {"fields": _MAX_FIELDS, "depth": _MAX_DEPTH, "longest": _MAX_NAME}
    words = {"fields": "fields", "depth": "levels of nesting", "longest": "characters in a dotted name"}
    for what, limit in most.items():
        if getattr(size, what) > limit:
            raise LogError(f"Expected message types with at most {limit} {words[what]}, got more in {name[:80]}.")


def held(description: Any) -> tuple[str, int, bool]:
    """Return a field's message type ("" for numbers and strings), its count, and whether it is a sequence."""
    # kinds in rosbags: 1 basic type, 2 message, 3 fixed-length array, 4 sequence
    kind, detail = int(description[0]), description[1]
    (node, name), length = (description, 1) if kind < 3 else detail
    return name if int(node) == 2 else "", length if kind == 3 else 1, kind == 4


def layout(raw: bytes | memoryview, name: str, types: Definitions) -> Layout:
    """Return the layout of one message."""
    if len(raw) < _HEADER or raw[0] != 0 or raw[1] not in (0, 1):
        raise LogError(
            f"Expected a {name} in plain CDR, got data starting with {bytes(raw[:4]).hex(' ') or 'no bytes'}."
        )
    walk = _Walk(raw, "<" if raw[1] else ">", types)
    try:
        walk.message(name, "", 0)
    except (struct.error, UnicodeDecodeError, KeyError, IndexError) as error:
        raise LogError(f"Expected a {name}, got {len(raw)} bytes that do not match it ({error}).") from None
    return Layout(tuple(walk.fields), walk.texts)


class _Walk:
    """Single-pass parser of a message."""

    def __init__(self, raw: bytes | memoryview, order: str, types: Definitions) -> None:
        self.raw, self.order, self.types = raw, order, types
        self.at = _HEADER
        self.left = _PER_BYTE * len(raw) + _EMPTY
        self.fields: list[Field] = []
        self.texts: dict[str, str | tuple[str, ...]] = {}

    def message(self, name: str, path: str, depth: int) -> None:
        if depth > _MAX_DEPTH:
            raise LogError(
                f"Expected message types nested at most {_MAX_DEPTH} levels deep, got more levels in {name}."
            )
        for field, description in self.types[name]:
            self.value(description, f"{path}.{field}" if path else field, depth)

    def value(self, description: Any, path: str, depth: int) -> None:
        self.left -= 1 + len(path) // _LETTERS
        if self.left < 0:
            raise LogError(
                f"Expected at most {_PER_BYTE} fields per byte, got more in {len(self.raw)} bytes up to {path}."
            )
        node, detail = int(description[0]), description[1]
        if node == 1 and detail[0] == "string":
            self.texts[path] = self.text()
        elif node == 1:
            self.numbers(detail[0], 1, path, scalar=True)
        elif node == 2:
            self.message(detail, path, depth + 1)
        else:
            element, length = detail
            self.several(element, length if node == 3 else self.count(), path, depth)

    def several(self, element: Any, count: int, path: str, depth: int) -> None:
        if count > len(self.raw):
            raise LogError(f"Expected at most {len(self.raw)} elements in {path}, got {count}.")
        if int(element[0]) == 2:
            for index in range(count):
                self.message(element[1], f"{path}[{index}]", depth + 1)
        elif element[1][0] == "string":
            self.texts[path] = tuple(self.text() for _ in range(count))
        else:
            self.numbers(element[1][0], count, path, scalar=False)

    def numbers(self, kind: str, count: int, path: str, scalar: bool) -> None:
        dtype, size = _SIZES[kind]
        if count:
            self.align(size)
        stop = self.at + count * size
        if stop > len(self.raw):
            raise LogError(f"Expected {count} numbers of type {kind} in {path}, got the end of the message.")
        dtype = dtype if size == 1 else self.order + dtype
        self.fields.append(Field(path, self.at, stop, dtype, count, scalar))
        self.at = stop

    def text(self) -> str:
        length = self.count()
        if length > len(self.raw) - self.at:
            raise LogError(f"Expected a string of {length} bytes, got the end of the message.")
        raw = bytes(self.raw[self.at : self.at + length])
        self.at += length
        return raw.removesuffix(b"\0").decode()

    def count(self) -> int:
        self.align(4)
        (value,) = struct.unpack_from(f"{self.order}I", self.raw, self.at)
        self.at += 4
        return value

    def align(self, size: int) -> None:
        self.at += -(self.at - _HEADER) % size
