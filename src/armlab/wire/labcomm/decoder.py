"""Decoder of LabComm streams.

A single generator walks through the stream and waits for missing bytes, so the events do not depend on how the stream
is split. A packet that states its length is decoded once it is complete. If a packet has no correct length (2013, 2006,
data of 2014old), the decoder traverses the content to find the end of the packet.
"""

from __future__ import annotations

from collections.abc import Generator, Set
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

from armlab.errors import LabCommError
from armlab.wire.labcomm.encoder import PRAGMA, SAMPLE_DEF, SAMPLE_REF, TYPE_BINDING, TYPE_DEF, VERSION
from armlab.wire.labcomm.types import (
    ARRAY,
    DIALECTS,
    PRIMS,
    SAMPLE,
    STRUCT,
    VOID,
    Array,
    Binding,
    Definition,
    Dialect,
    Event,
    Field,
    Kind,
    Other,
    Pragma,
    Sample,
    SampleType,
    Struct,
    Type,
    TypeRef,
    Unknown,
    Version,
    dialect_named,
)
from armlab.wire.labcomm.values import (
    Cursor,
    Cut,
    Limits,
    Number,
    Reader,
    Size,
    Source,
    Walk,
    checked_shape,
    decoded,
    label,
    number,
    reader,
)

FIRST_INDEX = 0x40
"""Smallest index of a sample or type; smaller numbers are tags and type codes."""

_BY_CODE = {prim.code: prim for prim in PRIMS.values()}


@dataclass
class SignatureWalk:
    """Parser of one signature."""

    source: Source
    dialect: Dialect
    limits: Limits
    end: int  # upper bound for the end of the signature
    type_refs: bool  # whether type indices may replace types (TYPE_DEF)
    nodes: int = 0

    def number(self, pos: int) -> Number:
        return number(self.source, pos, self.end, self.dialect.wide)

    def tree(self, first: int, depth: int = 1) -> Generator[None, None, tuple[Type, int]]:
        """Traverse one node and its children."""
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
        size = node.min_size(self.dialect.wide)
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
                raise _bad(where, "distinct field names in a struct", f"{name!r} again")
            part, pos = yield from self._part(pos, depth)
            fields[name] = Field(name, part, notes)
        return Struct(tuple(fields.values())), pos

    def _part(self, first: int, depth: int) -> Generator[None, None, tuple[Type, int]]:
        node, pos = yield from self.tree(first, depth + 1)
        if node == VOID:
            raise _bad(first, "a non-void type inside an array or struct", "void")
        return node, pos


def definition(
    source: Source, pos: int, end: int, kind: Kind, dialect: Dialect, limits: Limits
) -> Generator[None, None, tuple[Definition, int]]:
    """Traverse the body of a SAMPLE_DEF, SAMPLE_REF or TYPE_DEF; raise `Cut` if the body is too short."""
    first = pos
    index, pos = yield from number(source, pos, end, dialect.wide)
    if index < FIRST_INDEX:
        raise _bad(first, f"an index >= {FIRST_INDEX:#x}", f"{index:#x}")
    name, notes, pos = yield from label(source, pos, end, dialect, limits)
    declared, size = pos, None
    if dialect.lengths:
        size, pos = yield from number(source, pos, end, dialect.wide)
        if pos + size != end:
            raise _bad(
                declared, f"a signature within the remaining {end - pos} bytes of the packet", f"a length of {size}"
            )
    try:
        tree, pos = yield from SignatureWalk(source, dialect, limits, end, kind == "type").tree(pos)
    except Cut:
        if size is None:
            raise
        raise _bad(declared, f"a complete signature of {size} bytes", "a longer signature") from None
    if size is not None and pos != end:
        raise _bad(declared, f"a signature of {size} bytes", f"a signature that ends {end - pos} bytes earlier")
    return Definition(kind, index, name, tree, notes), pos


def value_end(source: Source, node: Type, pos: int, end: int, wide: bool, limits: Limits) -> Generator[None, None, int]:
    """Skip to the end of a value; raise `Cut` if the body would be too long."""
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
            raise _bad(where, "a string that ends within its packet", f"{size} bytes")
        pos += size
    if pos > end:
        raise Cut
    return pos


def _bad(offset: int, expected: str, got: str) -> LabCommError:
    return LabCommError(f"Expected {expected} at byte {offset}, got {got}.", offset)


HEADER = 10
"""Maximum combined size of a tag and a length [bytes]."""

_FIRST = {0x00: DIALECTS["2006"], 0x01: DIALECTS["2014"], 0x0B: DIALECTS["2013"]}


class Opening(NamedTuple):
    """Dialect assumed at the start of a stream, whether 2014 may turn out to be 2014i, and the announced version."""

    dialect: Dialect
    is_undecided: bool
    events: list[Version]


def opening(
    source: Source, given: Dialect | None, require_version: bool, limits: Limits
) -> Generator[None, None, Opening]:
    """Parse the version announcement, if any."""
    yield from source.need(1)
    first = source.buf[0]
    guess = _FIRST.get(first) if given is None else given
    if guess is None:
        raise _bad(0, "the beginning of a LabComm stream (00, 01 or 0b)", f"{first:02x}")
    announces = {"2013": 0x0B, "2006": first}.get(guess.name, VERSION)
    if first != announces and require_version:
        raise _bad(0, f"the VERSION of {guess.name}", f"{first:02x}")
    if first != announces or guess.name == "2006":
        return Opening(guess, False, [])
    if guess.name == "2013":
        yield from source.need(12)
        if source.slice(1, 12) != guess.version.encode():
            raise _bad(0, guess.version, repr(source.slice(1, 12)))
        source.at = 12
        return Opening(guess, False, [Version(guess.version)])
    every = {dialect.version for dialect in DIALECTS.values() if dialect.lengths}
    text, extra = yield from version(source, every if given is None else {guess.version}, limits)
    if given is None and text == DIALECTS["2014v1"].version:
        guess = DIALECTS["2014v1"]
    if guess.name == "2014" and extra:
        guess = DIALECTS["2014old"]
    return Opening(guess, given is None and guess.name == "2014", [Version(text)])


def version(source: Source, wanted: Set[str], limits: Limits) -> Generator[None, None, tuple[str, int]]:
    """Parse VERSION; return its text and the excess (0 or 1) of its declared length."""
    end = source.at + 2 * HEADER + limits.packet
    _, where = yield from number(source, source.at, end, wide=False)
    declared, begin = yield from number(source, where, end, wide=False)
    size, pos = yield from number(source, begin, end, wide=False)
    if size > limits.version:
        raise _bad(begin, f"a VERSION of at most {limits.version} bytes", f"{size} bytes")
    stop = pos + size
    yield from source.need(stop)
    text = source.slice(pos, stop).decode("ascii", "replace")
    if text not in wanted:
        raise _bad(begin, " or ".join(sorted(wanted)), repr(text))
    extra = declared - (stop - begin)
    if extra not in (0, 1):
        raise _bad(where, f"a length of {stop - begin}", str(declared))
    source.at = stop
    return text, extra


@dataclass(eq=False)
class Known:
    """Sample type and the reader of its values, created on first use."""

    index: int
    name: str
    type: Type
    left: int  # number of values allowed in a packet in addition to the fixed values

    @cached_property
    def read(self) -> Reader:
        return reader(self.type)


class Tables:
    """Samples, references and types by index, and the readers for the samples."""

    def __init__(self, limits: Limits) -> None:
        self.kinds: dict[Kind, dict[int, SampleType]] = {"sample": {}, "ref": {}, "type": {}}
        self.known: dict[int, Known] = {}
        self._limits, self._nodes = limits, 0

    def keep(self, event: Definition, offset: int) -> None:
        """Store a definition, which replaces an earlier definition with the same index."""
        table, entry = self.kinds[event.kind], SampleType(event.name, event.type)
        old = table.get(event.index)
        if old == entry:
            return
        nodes = self._nodes + event.type.nodes - (0 if old is None else old.type.nodes)
        limits = self._limits
        if (old is None and len(table) >= limits.definitions) or nodes > limits.nodes:
            most = f"at most {limits.definitions} definitions and {limits.nodes} nodes"
            raise LabCommError(f"Expected {most} in a stream, got more at byte {offset}.", offset)
        self._nodes, table[event.index] = nodes, entry
        if event.kind == "sample":
            self.known[event.index] = Known(event.index, event.name, event.type, limits.values - event.type.values)


_KINDS: dict[int, Kind] = {SAMPLE_DEF: "sample", SAMPLE_REF: "ref", TYPE_DEF: "type"}


class Decoder:
    """Decoder of one stream.

    Parameters
    ----------
    dialect : name of the dialect; "auto" detects it from the first bytes.
    limits : limits of the stream; default: `Limits.server()`.
    require_version : whether the stream must start with VERSION; False requires the name of a dialect.

    Attributes
    ----------
    refs : sample types by the index of their SAMPLE_REF.
    samples : sample types by the index of their SAMPLE_DEF.

    Raises
    ------
    UnknownName : if the dialect is unknown.
    LabCommError : if no dialect is given for a stream without VERSION.
    """

    refs: dict[int, SampleType]
    samples: dict[int, SampleType]

    def __init__(self, dialect: str = "auto", limits: Limits | None = None, require_version: bool = True) -> None:
        if dialect == "auto" and not require_version:
            raise LabCommError('Expected a dialect for a stream without VERSION, got "auto". Specify the dialect.')
        self._given = None if dialect == "auto" else dialect_named(dialect)
        self._dialect, self._undecided = self._given, False
        self._limits, self._require_version = limits or Limits.server(), require_version
        self._tables, self._source = Tables(self._limits), Source()
        self.refs, self.samples = self._tables.kinds["ref"], self._tables.kinds["sample"]
        self._events: list[Event] = []
        self._error: LabCommError | None = None
        self._closed = False
        self._walk = self._run()

    @property
    def dialect(self) -> str | None:
        """Name of the dialect; None until it is detected, and 2014 until a definition identifies 2014i."""
        return None if self._dialect is None else self._dialect.name

    def feed(self, data: bytes | bytearray | memoryview) -> list[Event]:
        """Process the next bytes and return the completed events.

        Parameters
        ----------
        data : the next bytes of the stream, of any length.

        Raises
        ------
        LabCommError : if the stream is malformed. The error's `offset` is the position of the fault, and
            `events` contains the events before the fault. Every later call raises the same error.
        """
        if self._error is not None:
            raise self._error
        if self._closed:
            raise LabCommError(f"Expected no bytes after close, got {len(data)}. Create a new Decoder.")
        self._source.add(data)
        try:
            next(self._walk)
        except LabCommError as error:
            self._error = error
            error.events, self._events = list(self._events), []
            raise
        events, self._events = self._events, []
        return events

    def close(self) -> None:
        """End the stream.

        Raises
        ------
        LabCommError : if the stream ended within a packet.
        """
        source = self._source
        if self._error is None and not self._closed and source.stop > source.at:
            left = source.stop - source.at
            self._error = LabCommError(
                f"Expected the rest of the packet at byte {source.at}, got the end of the stream after {left} bytes.",
                source.at,
            )
            raise self._error
        self._closed = True

    @property
    def pending(self) -> int:
        """Number of received bytes of the incomplete packet."""
        return self._source.stop - self._source.at

    @property
    def offset(self) -> int:
        """Stream position of the incomplete packet or, if there is none, of the next packet."""
        return self._source.at

    def _run(self) -> Walk:
        start = yield from opening(self._source, self._given, self._require_version, self._limits)
        dialect = self._dialect = start.dialect
        self._undecided = start.is_undecided
        self._events += start.events
        while True:
            if dialect.lengths:
                yield from self._packets(dialect)
                dialect = self._dialect or dialect
            else:
                yield from self._bare(dialect)

    def _packets(self, dialect: Dialect) -> Walk:
        """Traverse packets with a length field until the dialect changes from 2014 to 2014i.

        Most packets have the same type as the previous packet. If packets of this type have a fixed size, comparing the
        packet headers is sufficient.
        """
        source, limits = self._source, self._limits
        buf, cursor = source.buf, Cursor(source.buf, limits, wide=False)
        head, skipped, total, last = b"", 0, 0, None
        while True:
            start = source.at - source.base
            if last is not None and buf.startswith(head, start) and start + total <= len(buf):
                cursor.at, cursor.end = start + skipped, start + total
                self._events.append(self._sample(last, cursor))
                source.at += total
                continue
            if start == len(buf):
                yield
                continue
            cursor.base, cursor.at, cursor.end = source.base, start, len(buf)
            try:
                tag = cursor.number()
                where = cursor.at
                length = cursor.number()
            except Cut:
                yield
                continue
            offset, body, last = source.base + where, cursor.at, None
            if length > limits.packet:
                raise _bad(offset, f"a packet of at most {limits.packet} bytes", f"{length}")
            if tag == VERSION:
                text, _ = yield from version(source, {dialect.version}, limits)
                self._events.append(Version(text))
                continue
            known = self._tables.known.get(tag)
            if known is not None and not dialect.trusted:
                yield from self._measured(known, dialect, source.base + body)
                continue
            if known is not None and known.type.fixed_size is not None:
                if known.type.fixed_size != length:
                    raise _bad(offset, f"a length of {known.type.fixed_size}", str(length))
                last, head, skipped, total = known, bytes(buf[start:body]), body - start, body - start + length
            if body + length > len(buf):
                yield
                continue
            self._events.append(self._whole(tag, known, cursor, offset, length))
            source.at = source.base + cursor.end
            if self._dialect is not dialect:
                return

    def _whole(self, tag: int, known: Known | None, cursor: Cursor, offset: int, length: int) -> Event:
        """Decode a complete packet, whose length is at `offset`; raise an error if bytes remain."""
        cursor.end = cursor.at + length
        try:
            event = self._packet(tag, cursor) if known is None else self._sample(known, cursor)
        except Cut:
            raise _bad(offset, "a longer body", f"only {length} bytes") from None
        if cursor.at != cursor.end:
            raise _bad(offset, f"a length of {length - cursor.end + cursor.at}", str(length))
        return event

    def _packet(self, tag: int, cursor: Cursor) -> Event:
        """Decode a complete packet that is not a sample with a defined index."""
        if tag in _KINDS:
            return self._define(_KINDS[tag], cursor)
        if tag == TYPE_BINDING:
            return Binding(cursor.number(), cursor.number())
        where = cursor.base + cursor.at
        size = cursor.number() if tag == PRAGMA else 0
        body = bytes(cursor.buf[cursor.at : cursor.end])
        cursor.at = cursor.end
        if tag == PRAGMA:
            if size > len(body):
                raise _bad(where, f"a string of at most {len(body)} bytes", str(size))
            return Pragma(decoded(body[:size]), body[size:])
        return Other(tag, body) if tag < FIRST_INDEX else Unknown(tag, body)

    def _sample(self, known: Known, cursor: Cursor) -> Sample:
        cursor.left = known.left
        return Sample(known.index, known.name, known.read(cursor), known.type)

    def _define(self, kind: Kind, cursor: Cursor) -> Definition:
        """Decode a complete definition; in a stream of undetermined dialect, the first definition distinguishes 2014
        from 2014i."""
        dialect = self._dialect or DIALECTS["2014"]
        start, end = cursor.base + cursor.at, cursor.base + cursor.end
        try:
            event = self._whole_definition(kind, dialect, start, end)
        except (LabCommError, Cut) as fault:
            if not self._undecided:
                raise
            dialect = DIALECTS["2014i"]
            try:
                event = self._whole_definition(kind, dialect, start, end)
            except (LabCommError, Cut):
                raise fault from None
        self._dialect, self._undecided = dialect, False
        cursor.at = cursor.end
        self._tables.keep(event, start)
        return event

    def _whole_definition(self, kind: Kind, dialect: Dialect, start: int, end: int) -> Definition:
        try:
            next(definition(self._source, start, end, kind, dialect, self._limits))
        except StopIteration as done:
            return done.value[0]
        raise Cut  # unreachable for a complete packet

    def _bare(self, dialect: Dialect) -> Walk:
        """Traverse one packet that has no length field."""
        source, limits = self._source, self._limits
        start = source.at
        tag, pos = yield from number(source, start, start + HEADER, dialect.wide)
        known = self._tables.known.get(tag)
        if known is not None:
            yield from self._measured(known, dialect, pos)
        elif tag == SAMPLE_DEF:
            try:
                event, end = yield from definition(source, pos, pos + limits.packet, "sample", dialect, limits)
            except Cut:
                raise _bad(start, f"a definition of at most {limits.packet} bytes", "a longer definition") from None
            self._tables.keep(event, pos)
            self._events.append(event)
            source.at = end
        else:
            raise _bad(start, "a definition, or data with a defined index", f"tag {tag:#x}")

    def _measured(self, known: Known, dialect: Dialect, pos: int) -> Walk:
        """Find the end of a value, then decode the value."""
        source, limits, start = self._source, self._limits, self._source.at
        try:
            stop = yield from value_end(source, known.type, pos, pos + limits.packet, dialect.wide, limits)
        except Cut:
            raise _bad(start, f"a value of at most {limits.packet} bytes", "a longer value") from None
        yield from source.need(stop)
        cursor = Cursor(source.buf, limits, dialect.wide)
        cursor.base, cursor.at, cursor.end = source.base, pos - source.base, stop - source.base
        self._events.append(self._sample(known, cursor))
        source.at = stop
