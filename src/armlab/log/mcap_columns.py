"""Room for all messages of some channels, which the chunks of a file are copied into as they are unpacked.

The indexes of the chunks tell how many messages there are; the first message of a channel tells where its numbers are.
What is laid out in another way is left to `mcap_blocks`.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from armlab.errors import LogError
from armlab.kernels import MessageCopier
from armlab.log.mcap_blocks import Part
from armlab.log.mcap_chunk import Chunk, unpacked
from armlab.log.mcap_records import DAMAGE, MESSAGE, records
from armlab.log.mcap_variants import MessageReader, Values, variant_of

__all__ = ["Room"]

_RECORD = 31  # bytes of a record before its message: kind, length, channel, sequence, two times
_LARGEST = 1 << 31  # bytes of a chunk; a larger size is a damaged one
_TRIES = 8  # chunks in which the first messages of the channels are looked for


class Room:
    """Arrays for the messages of some channels.

    Parameters
    ----------
    view : bytes of the file. chunks : of it, in order. readers : by channel.
    """

    def __init__(self, view: memoryview, chunks: Sequence[Chunk], readers: Mapping[int, MessageReader]) -> None:
        self._columns: dict[int, _Columns] = {}
        messages = _first_messages(view, chunks, readers)
        for number, reader in readers.items():
            count = _counts(chunks, number)
            message = messages.get(number, b"")
            if message or not count.any():
                with suppress(*DAMAGE):  # of the message, and of sizes that there is no memory for
                    self._columns[number] = _columns(chunks, count, message, reader)
        columns = self._columns.values()
        self._first = list(zip(*(one.first for one in columns), strict=True)) or [()] * len(chunks)
        self._count = list(zip(*(one.count for one in columns), strict=True)) or [()] * len(chunks)
        self._copier = MessageCopier([one.told(number) for number, one in self._columns.items()])

    def copy(self, place: int, data: bytes) -> dict[int, range]:
        """Copy the messages of a chunk; return the rows of the channels whose messages all are as expected.

        Parameters
        ----------
        place : of the chunk among all. data : its records, unpacked.
        """
        first, count = self._first[place], self._count[place]
        copied = self._copier.copy(data, first, count)
        return {
            number: range(row, row + rows)
            for number, row, rows, whole in zip(self._columns, first, count, copied, strict=True)
            if whole
        }

    def part(self, number: int, rows: range) -> Part:
        """Return rows of a channel. From here on its arrays are read-only: a table takes them as they are."""
        columns, which = self._columns[number], slice(rows.start, rows.stop)
        numbers: Values = {}
        for path, array in columns.numbers.items():
            array.flags.writeable = False
            native = array[which].astype(array.dtype.newbyteorder("="), copy=False)
            native.flags.writeable = False
            numbers[((path, array.shape[1]),)] = native
        return Part(columns.sequence[which], columns.log_ns[which], [(np.arange(len(rows)), numbers)])


@dataclass(frozen=True, slots=True)
class _Columns:
    """Arrays of one channel.

    Attributes
    ----------
    first, count : row of the first message of each chunk, and how many it has; -1 where its index cannot be true.
    message, fixed, places : an example, the bytes in it that all messages have, and those of the numbers.
    sequence, log_ns, numbers : (N,) of the messages; by dotted name (N, count) in the file's byte order.
    """

    first: list[int]
    count: list[int]
    message: bytes
    fixed: Sequence[tuple[int, int]]
    places: Sequence[tuple[int, int]]
    sequence: np.ndarray
    log_ns: np.ndarray
    numbers: dict[str, np.ndarray]

    def told(self, number: int) -> tuple[Any, ...]:
        """Return what `MessageCopier` has to know of the channel."""
        arrays = self.sequence, self.log_ns, list(self.numbers.values())
        return number, self.message, self.fixed, self.places, *arrays


def _counts(chunks: Sequence[Chunk], number: int) -> np.ndarray:
    """Return how many messages of a channel each chunk has, by its index."""
    places = np.array([chunk.indexes.get(number, (0, 0)) for chunk in chunks], dtype=np.int64).reshape(-1, 2)
    return (places[:, 1] - places[:, 0]) // 16


def _columns(chunks: Sequence[Chunk], count: np.ndarray, message: bytes, reader: MessageReader) -> _Columns:
    """Return arrays for so many messages like this one, none where there are none."""
    room = np.array([min(chunk.size, _LARGEST) // (_RECORD + len(message)) for chunk in chunks], dtype=np.int64)
    count = np.where(count > room, -1, count)
    ends = count.clip(0).cumsum()
    rows = int(ends[-1]) if len(ends) else 0
    fixed, places, numbers = [], {}, {}
    if message:
        layout = variant_of(np.frombuffer(message, dtype=np.uint8), reader)
        reader.variants.setdefault(len(message), []).append(layout)
        fixed = layout.fixed
        for run, (at, _, dtype) in layout.runs.items():
            for path, size in run:
                numbers[path] = np.empty((rows, size), dtype)
                places[path] = at, at + size * numbers[path].itemsize
                at = places[path][1]
    sequence, log_ns = np.empty(rows, "<u4"), np.empty(rows, "<i8")
    first = (ends - count.clip(0)).tolist()
    return _Columns(first, count.tolist(), message, fixed, list(places.values()), sequence, log_ns, numbers)


def _first_messages(view: memoryview, chunks: Sequence[Chunk], channels: Collection[int]) -> dict[int, bytes]:
    """Return the first message of each channel that has one in the first chunks."""
    found: dict[int, bytes] = {}
    for chunk in [one for one in chunks if one.indexes.keys() & set(channels)][:_TRIES]:
        missing = chunk.indexes.keys() & set(channels) - found.keys()
        try:
            data = unpacked(view, chunk) if missing else b""
        except LogError:
            continue
        for kind, start, stop in records(memoryview(data), 0, len(data)):
            number = data[start] | data[start + 1] << 8 if kind == MESSAGE and stop - start >= 22 else -1
            if number in missing:
                found[number] = data[start + 22 : stop]
                missing.discard(number)
            if not missing:
                break
    return found
