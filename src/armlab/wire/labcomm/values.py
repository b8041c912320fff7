"""Decoding and encoding of LabComm values within limits.

A walk is a generator that yields while bytes are missing. Positions and error offsets are relative to the start of
the stream.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter
from struct import Struct as Format
from struct import unpack_from
from typing import Any, NamedTuple

from armlab.errors import LabCommError
from armlab.wire.labcomm.types import (
    SAMPLE,
    Array,
    Dialect,
    Field,
    Notes,
    Prim,
    SampleType,
    Struct,
    Type,
    containers,
    typename,
)


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of a decoder, which raises an error before it allocates memory for a value that exceeds them.

    Attributes
    ----------
    packet : maximum number of bytes in a packet body.
    values : maximum number of values in a packet (including containers), array elements, and nodes in a definition.
    definitions : maximum number of definitions in a table.
    nodes : maximum number of type nodes stored per stream.
    empty_rows : maximum number of array rows without elements.
    depth : maximum number of levels in a type; the root is level 1.
    name : maximum number of bytes in a name.
    version : maximum number of bytes in a VERSION.
    dims : maximum number of dimensions of an array.
    entries : maximum number of notes per name.
    """

    packet: int
    values: int
    definitions: int
    nodes: int
    empty_rows: int = 256
    depth: int = 32
    name: int = 255
    version: int = 64
    dims: int = 16
    entries: int = 64

    @classmethod
    def server(cls) -> Limits:
        """Return the limits for peers on the network: 64 KiB per packet, 16 384 values, 1024 definitions."""
        return cls(packet=65_536, values=16_384, definitions=1024, nodes=65_536)

    @classmethod
    def file(cls) -> Limits:
        """Return the limits for files: 16 MiB per packet, 2 097 152 values, 4096 definitions."""
        return cls(packet=16_777_216, values=2_097_152, definitions=4096, nodes=1_048_576)


Walk = Generator[None, None, None]
Number = Generator[None, None, tuple[int, int]]


class Cut(Exception):
    """Raised if the body of a packet is too short for its content."""


class Source:
    """Received bytes, starting at the current packet."""

    def __init__(self) -> None:
        self.buf: bytearray = bytearray()
        self.base = self.at = 0  # positions of the first byte and of the current packet

    @property
    def stop(self) -> int:
        """Position after the last received byte."""
        return self.base + len(self.buf)

    def add(self, data: bytes | bytearray | memoryview) -> None:
        """Append bytes and discard those before the current packet."""
        if self.at > self.base:
            del self.buf[: self.at - self.base]
            self.base: int = self.at
        self.buf += data

    def slice(self, start: int, stop: int) -> bytes:
        """Return the received bytes between two positions."""
        return bytes(self.buf[start - self.base : stop - self.base])

    def need(self, stop: int) -> Walk:
        """Wait for the bytes up to a position."""
        while self.base + len(self.buf) < stop:
            yield


def number(source: Source, pos: int, end: int, wide: bool) -> Number:
    """Read a number; `end` is an upper bound for the end of the body."""
    if wide:
        if pos + 4 > end:
            raise Cut
        yield from source.need(pos + 4)
        return int.from_bytes(source.slice(pos, pos + 4), "big"), pos + 4
    value = 0
    for at in range(pos, pos + 5):
        if at >= end:
            raise Cut
        yield from source.need(at + 1)
        byte = source.buf[at - source.base]
        value = value << 7 | byte & 0x7F
        if byte < 0x80:
            if value < 2**32:
                return value, at + 1
            raise LabCommError(f"Expected a number below 2**32 at byte {pos}, got {value}.", pos)
    raise LabCommError(f"Expected a number of at most 5 bytes at byte {pos}, got more.", pos)


def text(source: Source, pos: int, end: int, wide: bool, longest: int) -> Generator[None, None, tuple[str, int]]:
    """Read the string of a label, which must be valid UTF-8."""
    size, start = yield from number(source, pos, end, wide)
    if size > longest:
        raise LabCommError(f"Expected a name of at most {longest} bytes at byte {pos}, got {size}.", pos)
    if start + size > end:
        raise LabCommError(f"Expected a string that ends within its packet at byte {pos}, got {size} bytes.", pos)
    yield from source.need(start + size)
    raw = source.slice(start, start + size)
    try:
        return raw.decode(), start + size
    except UnicodeDecodeError:
        raise LabCommError(f"Expected a name in UTF-8 at byte {pos}, got {raw[:32]!r}.", pos) from None


def label(
    source: Source, pos: int, end: int, dialect: Dialect, limits: Limits
) -> Generator[None, None, tuple[str, Notes, int]]:
    """Read a name and its notes."""
    if not dialect.maps:
        name, pos = yield from text(source, pos, end, dialect.wide, limits.name)
        return name, (), pos
    first = pos
    count, pos = yield from number(source, pos, end, dialect.wide)
    if count > limits.entries:
        raise LabCommError(f"Expected at most {limits.entries} notes at byte {first}, got {count}.", first)
    entries: dict[str, str] = {}
    for _ in range(count):
        where = pos
        key, pos = yield from text(source, pos, end, dialect.wide, limits.name)
        if key in entries:
            raise LabCommError(f"Expected distinct notes, got {key!r} twice, at byte {where}.", where)
        entries[key], pos = yield from text(source, pos, end, dialect.wide, limits.name)
    if "" not in entries:
        raise LabCommError(f"Expected a name under the empty key at byte {first}, got no name.", first)
    name = entries.pop("")
    return name, tuple(sorted(entries.items())), pos


class Size(NamedTuple):
    """Size of a dimension and the position where it was read."""

    size: int
    offset: int


class Shape(NamedTuple):
    """Sizes of an array, its number of elements, and the position of the last size read (None: all fixed)."""

    sizes: tuple[int, ...]
    total: int
    last: int | None


def checked_shape(node: Array, read: Sequence[Size], rest: int, wide: bool, limits: Limits) -> Shape:
    """Return the shape of an array whose elements have at most `rest` bytes."""
    offsets = iter(read)
    sizes, product, seen_zero, last = [], 1, False, None
    for size in node.dims:
        if not size:
            size, last = next(offsets)
            if size > limits.values:
                raise _bad_array(last, f"a size of at most {limits.values}", size)
        seen_zero = seen_zero or not size
        if not seen_zero:
            product *= size
            if product > limits.values and last is not None:
                raise _bad_array(last, f"at most {limits.values} elements", product)
        sizes.append(size)
    count = math.prod(sizes)
    if not count and product > limits.empty_rows and last is not None:
        raise _bad_array(last, f"at most {limits.empty_rows} rows without elements", product)
    smallest = count * node.elem.min_size(wide)
    if smallest > rest:
        if last is None:
            raise Cut
        raise _bad_array(last, f"elements within the remaining {rest} bytes of the packet", f"{smallest} bytes")
    return Shape(tuple(sizes), count, last)


def nest(flat: list[Any], sizes: tuple[int, ...]) -> list[Any]:
    """Return the elements as nested lists."""
    if not flat and len(sizes) > 1:
        return [nest(flat, sizes[1:]) for _ in range(sizes[0])]
    for size in reversed(sizes[1:]):
        flat = [flat[start : start + size] for start in range(0, len(flat), size)]
    return flat


def _bad_array(offset: int, expected: str, got: object) -> LabCommError:
    return LabCommError(f"Expected {expected} in the array at byte {offset}, got {got}.", offset)


@dataclass(slots=True)
class Cursor:
    """Position of a reader in a complete packet."""

    buf: bytes | bytearray
    limits: Limits
    wide: bool
    at: int = 0  # index of the next byte in `buf`
    end: int = 0  # index of the end of the body in `buf`
    base: int = 0  # position of ``buf[0]``
    left: int = 0  # number of values still allowed in the packet

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
        """Read and validate the variable sizes of an array."""
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
    """Return a reader for values of a type."""
    if isinstance(node, Prim):
        return _prim(node) if node.letter else _string
    if isinstance(node, Array):
        return _array(node)
    if isinstance(node, Struct):
        return _struct(node)
    raise LabCommError(f"Expected a type with readable values, got a reference to type {node.index}.")


def runs(node: Struct) -> list[list[Field]]:
    """Return the fields of a struct in order, grouped so that each group needs only one `struct` call."""
    found: list[list[Field]] = []
    for _, group in groupby(node.fields, key=lambda field: flat_form(field.type) is not None):
        fields = list(group)
        found += [fields] if flat_form(fields[0].type) else [[field] for field in fields]
    return found


def flat_form(node: Type) -> tuple[str, int] | None:
    """Return the `struct` format of a fixed row of numbers and its count (-1: scalar), or None for other types."""
    size = -1
    if isinstance(node, Array) and len(node.dims) == 1 and node.dims[0]:
        size, node = node.dims[0], node.elem
    if isinstance(node, Prim) and node.letter not in ("", "?", "B"):
        return f"{abs(size)}{node.letter}", size
    return None


def _flat_forms(fields: Sequence[Field]) -> tuple[Format, list[int]]:
    """Return the common format of fields for one `struct` call, and the count of each field."""
    forms = [form for field in fields if (form := flat_form(field.type)) is not None]
    return Format(">" + "".join(letters for letters, _ in forms)), [count for _, count in forms]


def decoded(raw: bytes) -> str:
    """Decode a string as UTF-8, otherwise as Java's modified UTF-8, otherwise with escaped bytes."""
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
    """Return a reader that unpacks all fields in one `struct` call, with a slice or an index for each field."""
    form, counts = _flat_forms(fields)
    unpack, size = form.unpack_from, form.size
    names, places, at = [field.name for field in fields], [], 0
    for count in counts:
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


Writer = Callable[[Any], bytes]


class Misfit(Exception):
    """Value that does not match its type, with the path to the invalid part, innermost element first."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self.text: str = text
        self.path: list[str] = []


class Wire(NamedTuple):
    """Encoding options: dialect, whether strings may contain NUL, and the index of a referenced sample type."""

    dialect: Dialect
    allow_nul: bool
    index_of: Callable[[SampleType], int]


def writer(node: Type, wire: Wire) -> Writer:
    """Return a writer for values of a type."""
    if isinstance(node, Prim):
        return _write_prim(node, wire)
    if isinstance(node, Array):
        return _write_array(node, wire)
    if isinstance(node, Struct):
        return _write_struct(node, wire)
    raise LabCommError(f"Expected a type with writable values, got a reference to type {node.index}.")


def _write_prim(node: Prim, wire: Wire) -> Writer:
    if not node.letter:
        return lambda value: _text(value, wire)
    pack, name = Format(">" + node.letter).pack, node.name

    def write(value: Any) -> bytes:
        if node.code == SAMPLE and isinstance(value, SampleType):
            value = wire.index_of(value)
        if name == "boolean" and not _is_boolean(value):
            raise Misfit(f"expected True or False, got {value!r}")
        try:
            return pack(value)
        except (struct.error, TypeError, ValueError, OverflowError):
            raise Misfit(f"expected a value of type {name}, got {value!r}") from None

    return write


def _is_boolean(value: Any) -> bool:
    return (isinstance(value, int) and value in (0, 1)) or type(value).__name__ in ("bool", "bool_")


def _text(value: Any, wire: Wire) -> bytes:
    if not isinstance(value, str):
        raise Misfit(f"expected a string, got {value!r}")
    if "\0" in value and not wire.allow_nul:
        raise Misfit("expected a string without NUL, because NUL terminates it in C")
    try:
        return wire.dialect.text(value.encode("utf-8", "surrogateescape"))
    except UnicodeEncodeError:
        raise Misfit(f"expected a string that can be encoded as UTF-8, got {value!r}") from None


def _write_struct(node: Struct, wire: Wire) -> Writer:
    parts = [_write_flat(run, wire) if len(run) > 1 else _field(run[0], wire) for run in runs(node)]
    count = len(node.fields)

    def write(value: Any) -> bytes:
        try:
            if len(value) == count:
                return b"".join([part(value) for part in parts])
        except (TypeError, LookupError):
            pass
        raise _unlike(value, [field.name for field in node.fields])

    return write


def _write_flat(fields: Sequence[Field], wire: Wire) -> Writer:
    """Return a writer that uses one `struct` call; if it fails, values are written singly to find the invalid value."""
    form, counts = _flat_forms(fields)
    pack, parts = form.pack, list(zip([field.name for field in fields], counts, strict=True))
    one_by_one = [_field(field, wire) for field in fields]

    def write(value: Any) -> bytes:
        flat: list[Any] = []
        try:
            for name, count in parts:
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
    """Return the writer of one field."""
    name, part = field.name, writer(field.type, wire)

    def write(value: Any) -> bytes:
        try:
            return part(value[name])
        except Misfit as error:
            error.path.append(f".{name}")
            raise

    return write


def _unlike(value: Any, names: Sequence[str]) -> Misfit:
    """Return the error for a value whose fields do not match its struct."""
    if not isinstance(value, Mapping):
        return Misfit(f"expected a dict, got {value!r}")
    missing, extra = sorted(set(names) - value.keys()), sorted(map(str, value.keys() - set(names)))
    given = (
        f"but {', '.join(missing)} {'is' if len(missing) == 1 else 'are'} missing"
        if missing
        else f"but also got {', '.join(extra)}"
    )
    return Misfit(f"expected {'the fields ' + ', '.join(names) if names else 'no fields'}, {given}")


def _write_array(node: Array, wire: Wire) -> Writer:
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
                pass  # writing the elements one by one locates the fault
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
    """Return the elements in order and the sizes; raise an error if the list is not rectangular."""
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
            raise Misfit(f"expected rows of equal length, got {' and '.join(map(str, given))} values")
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
    raise Misfit(f"expected a list for {typename(node)}{path}, got {value!r}")


def _check(sizes: Sequence[int], dims: Sequence[int]) -> None:
    for size, fixed in zip(sizes, dims, strict=True):
        if fixed and size != fixed:
            raise Misfit(f"expected {fixed} values, got {size}")


def _place(index: int, sizes: Sequence[int]) -> str:
    places = []
    for size in reversed(sizes):
        index, place = divmod(index, size)
        places.append(f"[{place}]")
    return "".join(reversed(places))
