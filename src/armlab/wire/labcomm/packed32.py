"""packed32: LabComm's unsigned number, base 128, most significant group first, bit 7 set on every byte but the last."""

from __future__ import annotations

from armlab.errors import LabCommError

__all__ = ["decode", "encode"]

_LARGEST = 2**32 - 1
_LONGEST = 5  # bytes


def encode(n: int) -> bytes:
    """Return the shortest form of a number: 0 is 00, 128 is 81 00, 300 is 82 2c.

    Parameters
    ----------
    n : from 0 to 2**32 - 1.

    Raises
    ------
    LabCommError : the number is out of range.
    """
    if 0 <= n < 0x80:
        return bytes((n,))
    if not 0 <= n <= _LARGEST:
        raise LabCommError(f"Expected a number from 0 to {_LARGEST}, got {n}.")
    groups = [n & 0x7F]
    while n := n >> 7:
        groups.append(n & 0x7F | 0x80)
    return bytes(reversed(groups))


def decode(buf: bytes | bytearray, pos: int) -> tuple[int, int]:
    """Return the number at a position and the position after it. Longer forms, up to 5 bytes, are read.

    Parameters
    ----------
    buf : the bytes. pos : where the number begins.

    Raises
    ------
    LabCommError : no end within 5 bytes or within `buf`, or a number above 2**32 - 1.
    """
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
