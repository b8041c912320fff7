"""`Dialect`: the differences between the generations of LabComm; packed32, their unsigned number."""

from __future__ import annotations

from dataclasses import dataclass

from armlab.errors import LabCommError, UnknownName

_LARGEST = 2**32 - 1
_LONGEST = 5  # bytes


def encode_packed32(n: int) -> bytes:
    """Return the shortest form of a number: 0 is 00, 128 is 81 00, 300 is 82 2c."""
    if 0 <= n < 0x80:
        return bytes((n,))
    if not 0 <= n <= _LARGEST:
        raise LabCommError(f"Expected a number from 0 to {_LARGEST}, got {n}.")
    groups = [n & 0x7F]
    while n := n >> 7:
        groups.append(n & 0x7F | 0x80)
    return bytes(reversed(groups))


def decode_packed32(buf: bytes | bytearray, pos: int) -> tuple[int, int]:
    """Return the number at a position and the position after it. Longer forms, up to 5 bytes, are read."""
    n = 0
    for at in range(pos, min(pos + _LONGEST, len(buf))):
        byte = buf[at]
        n = n << 7 | byte & 0x7F
        if byte < 0x80:
            if n > _LARGEST:
                break
            return n, at + 1
    raise _wrong(buf[pos : pos + _LONGEST], pos)


def _wrong(raw: bytes | bytearray, offset: int) -> LabCommError:
    """Return the error for bytes that are no packed32."""
    text = bytes(raw).hex(" ") or "the end"
    return LabCommError(f"Expected a packed32 below 2**32 in at most 5 bytes at byte {offset}, got {text}.", offset)


Notes = tuple[tuple[str, str], ...]


@dataclass(frozen=True, slots=True)
class Dialect:
    """One generation of the format.

    `name`: "2014v1", "2014", "2014i", "2014old", "2013" or "2006"; `version`: what a stream announces, "" for nothing;
    `lengths`: packets carry the length of their body; `trusted`: and that length is right; `wide`: numbers are 4 bytes
    instead of packed32; `maps`: names are maps of strings (intentions); `references`: samples may refer to sample
    types.
    """

    name: str
    version: str
    lengths: bool = True
    trusted: bool = True
    wide: bool = False
    maps: bool = False
    references: bool = True

    def number(self, n: int) -> bytes:
        """Return a number as this dialect writes it."""
        if not self.wide:
            return encode_packed32(n)
        if not 0 <= n < 2**32:
            raise LabCommError(f"Expected a number from 0 to {2**32 - 1}, got {n}.")
        return n.to_bytes(4, "big")

    def text(self, raw: bytes) -> bytes:
        """Return a string: its length in bytes, then the bytes."""
        return self.number(len(raw)) + raw

    def label(self, name: str, notes: Notes = ()) -> bytes:
        """Return a name, with its notes where the dialect has them (`notes`: pairs of key and value)."""
        try:
            if not self.maps:
                return self.text(name.encode())
            entries = [("", name), *sorted(notes)]
            return self.number(len(entries)) + b"".join(self.text(part.encode()) for entry in entries for part in entry)
        except UnicodeEncodeError:
            raise LabCommError(f"Expected a name that UTF-8 can write, got {name!r}.") from None

    def packet(self, tag: int, body: bytes, length: int | None = None) -> bytes:
        """Return a packet; `length` replaces the length that is declared."""
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
    """Return a dialect."""
    if name not in DIALECTS:
        raise UnknownName.among("LabComm dialect", name, DIALECTS)
    return DIALECTS[name]
