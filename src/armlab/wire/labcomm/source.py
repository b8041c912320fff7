"""The bytes of a stream while they arrive, walks over them that wait for more, and `Limits` of what a stream may ask.

A walk is a generator: it yields when it needs bytes that have not come, and goes on where it was. All positions are
those of the stream, so they are the offsets of errors too.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass

from armlab.errors import LabCommError
from armlab.wire.labcomm.dialects import Dialect, Notes


@dataclass(frozen=True, slots=True)
class Limits:
    """Bounds of a decoder; beyond one of them a stream is refused before anything is built.

    Attributes
    ----------
    packet : bytes of a body. values : leaves and containers of a packet, one size, nodes of a definition.
    definitions : per table. nodes : kept per stream.
    empty_rows : product of the sizes before a size of zero. depth : levels of a type, the root is level 1.
    name, version : bytes. dims : of an array. entries : of a name with notes.
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
    """The body ends before what it must hold."""


class Source:
    """The bytes from the beginning of the current packet on.

    `buf`: the bytes; `base`: position of the first of them; `at`: position of the current packet.
    """

    def __init__(self) -> None:
        self.buf = bytearray()
        self.base = self.at = 0

    @property
    def stop(self) -> int:
        """Position after the last byte that has come."""
        return self.base + len(self.buf)

    def add(self, data: bytes | bytearray | memoryview) -> None:
        """Append bytes and forget those before the current packet."""
        if self.at > self.base:
            del self.buf[: self.at - self.base]
            self.base = self.at
        self.buf += data

    def slice(self, start: int, stop: int) -> bytes:
        """Return bytes that have come."""
        return bytes(self.buf[start - self.base : stop - self.base])

    def need(self, stop: int) -> Walk:
        """Wait until the bytes up to a position have come."""
        while self.base + len(self.buf) < stop:
            yield


def number(source: Source, pos: int, end: int, wide: bool) -> Number:
    """Walk over a number; `end` is where the body ends at the latest."""
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
    """Walk over a string of strict UTF-8: part of a name."""
    size, start = yield from number(source, pos, end, wide)
    if size > longest:
        raise LabCommError(f"Expected a name of at most {longest} bytes at byte {pos}, got {size}.", pos)
    if start + size > end:
        raise LabCommError(f"Expected a string that ends in its packet at byte {pos}, got {size} bytes.", pos)
    yield from source.need(start + size)
    raw = source.slice(start, start + size)
    try:
        return raw.decode(), start + size
    except UnicodeDecodeError:
        raise LabCommError(f"Expected a name in UTF-8 at byte {pos}, got {raw[:32]!r}.", pos) from None


def label(
    source: Source, pos: int, end: int, dialect: Dialect, limits: Limits
) -> Generator[None, None, tuple[str, Notes, int]]:
    """Walk over a name and its notes."""
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
            raise LabCommError(f"Expected each note once, got {key!r} again at byte {where}.", where)
        entries[key], pos = yield from text(source, pos, end, dialect.wide, limits.name)
    if "" not in entries:
        raise LabCommError(f"Expected a name under the empty key at byte {first}, got none.", first)
    name = entries.pop("")
    return name, tuple(sorted(entries.items())), pos
