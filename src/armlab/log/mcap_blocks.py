"""The messages of channels in the records of some chunks, of any layout: found, told apart, decoded."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from armlab.log.mcap_chunk import Chunk
from armlab.log.mcap_records import MESSAGE, records
from armlab.log.mcap_variants import MessageReader, Piece, of_length, read_blocks

__all__ = ["Part", "decode_chunks", "decode_messages", "walked"]

_PREFIX = np.dtype(
    [("kind", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("log", "<i8"), ("publish", "<i8")]
)
_NO_OFFSETS = np.zeros(0, dtype=np.int64)


@dataclass(slots=True)
class Part:
    """Some messages of one channel: sequence numbers (k,), log times (k,) and numbers by layout.

    `bad` more do not fit their type, the first of them for the `reason`.
    """

    sequence: np.ndarray
    log_ns: np.ndarray
    pieces: Sequence[Piece] = ()
    bad: int = 0
    reason: str = ""


def decode_chunks(
    view: memoryview, chunks: Sequence[tuple[Chunk, bytes]], readers: Mapping[int, MessageReader], indexed: bool
) -> dict[int, Part]:
    """Return the messages in several chunks, decoded as if they were one.

    Without whole indexes, or where one is wrong, the records are walked.

    Parameters
    ----------
    view : bytes of the file. chunks : with their records, unpacked.
    readers : by channel. indexed : the indexes of the chunks name every message.
    """
    raw = np.frombuffer(b"".join(data for _, data in chunks), dtype=np.uint8)
    begin = np.cumsum([0, *(len(data) for _, data in chunks)])
    offsets = {}
    for number in readers if indexed else ():
        offsets[number] = np.concatenate([_indexed(view, one, number) + at for at, (one, _) in zip(begin, chunks)])
        indexed = indexed and _are_messages(raw, offsets[number], number)
    if not indexed:
        offsets = walked(raw.data, readers)
    return {number: decode_messages(raw, offsets[number], reader) for number, reader in readers.items()}


def _indexed(view: memoryview, chunk: Chunk, number: int) -> np.ndarray:
    """Return where the messages of a channel begin in a chunk, from its index."""
    start, stop = chunk.indexes.get(number, (0, 0))
    if not start:
        return _NO_OFFSETS
    return np.frombuffer(view[start:stop], dtype="<i8")[1::2]


def _are_messages(raw: np.ndarray, offsets: np.ndarray, number: int) -> bool:
    """Tell whether messages of the channel begin at the offsets, in increasing order and wholly inside."""
    if not len(offsets):
        return True
    if offsets[0] < 0 or offsets[-1] > len(raw) - _PREFIX.itemsize or (np.diff(offsets) <= 0).any():
        return False
    prefix = _items(raw, offsets, _PREFIX)
    length = prefix["length"]
    fits = (length >= 22) & (length <= len(raw)) & (offsets + 9 + length.astype(np.int64) <= len(raw))
    return bool((fits & (prefix["kind"] == MESSAGE) & (prefix["channel"] == number)).all())


def walked(data: bytes | memoryview, numbers: Collection[int]) -> dict[int, np.ndarray]:
    """Return where the messages of some channels begin by walking the records."""
    found: dict[int, list[int]] = {number: [] for number in numbers}
    for kind, start, stop in records(memoryview(data), 0, len(data)):
        if kind == MESSAGE and stop - start >= 22:
            number = data[start] | data[start + 1] << 8
            if number in found:
                found[number].append(start - 9)
    return {number: np.array(starts, dtype=np.int64) for number, starts in found.items()}


def _items(raw: np.ndarray, offsets: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """Return the items (k,) of a type that begin at the offsets, wherever they are: a view where evenly spaced."""
    steps = np.diff(offsets)
    if len(steps) and (steps == steps[0]).all():
        return np.ndarray((len(offsets),), dtype=dtype, buffer=raw, offset=int(offsets[0]), strides=(int(steps[0]),))
    places = max(len(raw) - dtype.itemsize + 1, 0)
    return np.ndarray((places,), dtype=dtype, buffer=raw, strides=(1,))[offsets]


def _blocks(raw: np.ndarray, offsets: np.ndarray, length: int) -> np.ndarray:
    """Return the bytes (k, length) that begin at the offsets."""
    if not length:
        return np.zeros((len(offsets), 0), dtype=np.uint8)
    found = _items(raw, offsets, np.dtype((np.void, length)))
    if found.base is None:
        return found.view(np.uint8).reshape(len(offsets), length)
    return np.ndarray((len(offsets), length), np.uint8, raw, int(offsets[0]), (found.strides[0], 1))


def decode_messages(raw: np.ndarray, offsets: np.ndarray, reader: MessageReader) -> Part:
    """Return the messages whose records begin at the offsets (k,) of some bytes."""
    if not len(offsets):
        return Part(np.zeros(0, dtype=np.uint32), np.zeros(0, dtype=np.int64))
    prefix = _items(raw, offsets, _PREFIX)
    lengths = prefix["length"].astype(np.int64) - 22
    same = of_length(lengths)
    blocks = ((rows, _blocks(raw, offsets[rows] + _PREFIX.itemsize, int(lengths[rows[0]]))) for rows in same)
    read = read_blocks(len(offsets), blocks, reader)
    return Part(prefix["sequence"][read.rows], prefix["log"][read.rows], read.pieces, read.bad, read.reason)
