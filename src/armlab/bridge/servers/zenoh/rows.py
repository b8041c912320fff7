"""`Inbox`: what has come and waits for the thread that reads it, bounded in number and in bytes."""

from __future__ import annotations

import struct
import threading
import zlib
from collections import deque
from typing import Any, Generic, TypeVar

from armlab.bridge.servers.row import LARGEST, RowSchema
from armlab.bridge.servers.zenoh.session import data_of

__all__ = ["Gaps", "Inbox", "checksum", "undamaged"]

_LARGEST = 2**26  # bytes of all that wait: ten seconds of all rows of twenty arms
_LEAST = 256  # bytes that a message is counted for at least

T = TypeVar("T")


class Inbox(Generic[T]):
    """Messages from Zenoh's threads; when too much waits the oldest are lost."""

    def __init__(self, most: int) -> None:
        self._most, self._size = most, 0
        self._waiting: deque[tuple[int, T]] = deque()
        self._came = threading.Condition(threading.Lock())

    def __len__(self) -> int:
        return len(self._waiting)

    def put(self, message: T, size: int = 0) -> None:
        """Keep a message, and wake who waits."""
        size = max(size, _LEAST)
        with self._came:
            while self._waiting and (len(self._waiting) >= self._most or self._size + size > _LARGEST):
                self._size -= self._waiting.popleft()[0]
            self._waiting.append((size, message))
            self._size += size
            self._came.notify()

    def get(self, patience: float = 0.0) -> T | None:
        """Return the oldest message and forget it, None when none comes in time."""
        with self._came:
            if not self._waiting and not (patience > 0.0 and self._came.wait(patience) and self._waiting):
                return None
            size, message = self._waiting.popleft()
            self._size -= size
            return message

    def wait(self, patience: float) -> bool:
        """Return whether a message waits, or comes in time."""
        with self._came:
            return bool(self._waiting) or self._came.wait(patience)


_NUMBER = struct.Struct("<q")


class Gaps:
    """Counts what a reader of every row of an arm ("state" or "live") misses."""

    def __init__(self, schema: RowSchema, robot: str) -> None:
        self._at = schema.fields[f"{robot}.tick"].offset
        self._last = -1
        self.rows = self.lost = self.starts = 0

    def take(self, data: bytes) -> int:
        """Count a row; return how many are missing before it."""
        (number,) = _NUMBER.unpack_from(data, self._at)
        if number <= self._last or not self.rows:  # another run begins anew
            self.starts += 1
            missing = 0
        else:
            missing = number - self._last - 1
        self._last = number
        self.rows += 1
        self.lost += missing
        return missing


_SUM = struct.Struct("<I")


def checksum(data: bytes) -> bytes:
    """Return the CRC-32 of a row, 4 bytes, little-endian.

    Reference: ISO 3309, the CRC-32 of zlib and Ethernet.
    """
    return _SUM.pack(zlib.crc32(data))


def undamaged(sample: Any) -> bytes | None:
    """Return the row of a sample, None when its checksum is wrong or missing, or when it is too large."""
    data = sample.payload.to_bytes()
    return data if len(data) <= LARGEST and data_of(sample.attachment) == checksum(data) else None
