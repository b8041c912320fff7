"""Numbers out of the messages of an MCAP file, a chunk at a time and without building objects.

The first message of a channel is walked field by field. All messages of equal length whose bytes outside the numbers
are the same hold their numbers in the same places, so those of a whole chunk are copied at once.
"""

from __future__ import annotations

import struct
import threading
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from armlab.errors import LogError
from armlab.log.description import Progress
from armlab.log.mcap_chunk import Chunk, unpacked
from armlab.log.mcap_records import DAMAGE, MESSAGE, Contents, records
from armlab.log.mcap_variants import MessageReader, Values, assembled, decode_block, split
from armlab.wire import cdr

__all__ = ["Decoded", "decode", "decode_by", "message_counts", "messages"]

_PREFIX = np.dtype(
    [("kind", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("log", "<i8"), ("publish", "<i8")]
)
_BATCH = 2_000_000  # bytes of records decoded at once: amortises calls, stays in the cache of a core

_NO_OFFSETS = np.zeros(0, dtype=np.int64)


@dataclass(slots=True)
class Decoded:
    """The messages of one channel.

    Attributes
    ----------
    sequence, log_ns : (N,) sequence numbers and log times.
    fields : dotted name -> (N, count); NaN where a message does not have it.
    """

    sequence: np.ndarray
    log_ns: np.ndarray
    fields: dict[str, np.ndarray]


@dataclass(slots=True)
class _Part:
    """The messages of one channel in some chunks."""

    sequence: np.ndarray
    log_ns: np.ndarray
    values: Values


def decode(
    view: memoryview, found: Contents, wanted: Mapping[int, Sequence[str]], progress: Progress | None = None
) -> tuple[dict[int, Decoded], list[str]]:
    """Return the wanted fields of the wanted channels, and one sentence per damaged chunk.

    Parameters
    ----------
    view : bytes of the file.
    found : its contents.
    wanted : channel -> dotted names of fields.
    progress : is told the bytes.

    Raises
    ------
    LogError : the schema of a wanted channel cannot be read.
    """
    readers = {}
    for number, paths in wanted.items():
        channel = found.channels[number]
        if channel.encoding != "cdr":
            raise LogError(f"Expected messages in cdr on {channel.topic}, got {channel.encoding!r}.")
        types = cdr.definitions(channel.type, channel.schema)
        readers[number] = MessageReader(channel.type, types, frozenset(paths))
    return decode_by(view, found, readers, progress)


def decode_by(
    view: memoryview, found: Contents, readers: Mapping[int, MessageReader], progress: Progress | None = None
) -> tuple[dict[int, Decoded], list[str]]:
    """Return what the readers of some channels read, and one sentence per damaged chunk.

    Parameters
    ----------
    view, found, progress : as in `decode`. readers : by channel.
    """
    chunks = [chunk for chunk in found.chunks if not found.indexed or chunk.indexes.keys() & readers.keys()]
    parts: dict[int, list[_Part]] = {number: [] for number in readers}
    damage: list[str] = []
    scratch = _Scratch()
    batches, done, total = list(_batches(chunks)), 0, sum(chunk.size for chunk in chunks)
    with ThreadPoolExecutor(2) as pool:  # decompression, checksums and copies release the interpreter lock
        results = pool.map(lambda batch: _decode_batch(view, batch, readers, found.indexed, scratch), batches)
        for batch, (decoded, lost) in zip(batches, results, strict=True):
            damage += lost
            for number, part in decoded.items():
                parts[number].append(part)
            done += sum(chunk.size for chunk in batch)
            if progress:
                progress(done, total, "bytes")
    if found.loose:
        for number, part in _decode_loose(view, found.loose, readers).items():
            parts[number].append(part)
    return {number: _joined(of_channel) for number, of_channel in parts.items()}, damage


def messages(view: memoryview, found: Contents, channel: int) -> Iterator[tuple[int, int, bytes]]:
    """Yield (sequence, log time, message) of one channel; damaged chunks are left out."""
    for chunk in found.chunks:
        if found.indexed and channel not in chunk.indexes:
            continue
        try:
            data = unpacked(view, chunk)
        except LogError:
            continue
        for kind, start, stop in records(memoryview(data), 0, len(data)):
            if kind == MESSAGE and stop - start >= 22:
                number, sequence, log, _ = struct.unpack_from("<HIQQ", data, start)
                if number == channel:
                    yield sequence, log, data[start + 22 : stop]
    for start, stop in found.loose:
        if stop - start >= 22:
            number, sequence, log, _ = struct.unpack_from("<HIQQ", view, start)
            if number == channel:
                yield sequence, log, bytes(view[start + 22 : stop])


def message_counts(view: memoryview, found: Contents) -> Counter[int]:
    """Return how many messages that can be read each channel has."""
    counts: Counter[int] = Counter()
    for chunk in found.chunks:
        if found.indexed:
            counts.update({number: (stop - start) // 16 for number, (start, stop) in chunk.indexes.items()})
            continue
        try:
            walked = _walked(unpacked(view, chunk), found.channels)
        except LogError:
            continue
        counts.update({number: len(offsets) for number, offsets in walked.items()})
    counts.update(struct.unpack_from("<H", view, start)[0] for start, stop in found.loose if stop - start >= 22)
    return counts


def _batches(chunks: Sequence[Chunk]) -> Iterator[list[Chunk]]:
    batch: list[Chunk] = []
    for chunk in chunks:
        batch.append(chunk)
        if sum(c.size for c in batch) > _BATCH:
            yield batch
            batch = []
    if batch:
        yield batch


class _Scratch(threading.local):
    """Memory of one thread that every batch uses again: fresh memory costs as much as the copy into it."""

    def __init__(self) -> None:
        self.memory = np.empty(0, dtype=np.uint8)

    def put(self, data: bytes, at: int) -> int:
        """Copy bytes to a place; return where they end."""
        stop = at + len(data)
        if stop > len(self.memory):
            self.memory = np.concatenate([self.memory[:at], np.empty(2 * stop - at, dtype=np.uint8)])
        self.memory[at:stop] = np.frombuffer(data, dtype=np.uint8)
        return stop


def _decode_batch(
    view: memoryview,
    chunks: Sequence[Chunk],
    readers: Mapping[int, MessageReader],
    indexed: bool,
    scratch: _Scratch,
) -> tuple[dict[int, _Part], list[str]]:
    """Decode several chunks as if they were one; damaged ones are left out and named.

    Without whole indexes, or where one is wrong, the records are walked.
    """
    whole: list[tuple[int, Chunk]] = []
    at, damage = 0, []
    for chunk in chunks:
        try:
            data = unpacked(view, chunk)
        except LogError as error:
            damage.append(f"chunk at byte {chunk.start} skipped: {error}")
            continue
        whole.append((at, chunk))
        at = scratch.put(data, at)
    raw = scratch.memory[:at]
    offsets = {}
    for number in readers if indexed else ():
        found = [_indexed(view, chunk, number) + at for at, chunk in whole]
        offsets[number] = np.concatenate(found) if found else _NO_OFFSETS
        indexed = indexed and _are_messages(raw, offsets[number], number)
    if not indexed:
        offsets = _walked(raw.data, readers)
    parts = {}
    for number, reader in readers.items():
        try:
            parts[number] = _decode_messages(raw, offsets[number], reader)
        except DAMAGE as error:
            damage.append(f"messages of type {reader.type} skipped: {error}")
    return parts, damage


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


def _walked(data: bytes | memoryview, numbers: Collection[int]) -> dict[int, np.ndarray]:
    """Return where the messages of some channels begin by walking the records."""
    found: dict[int, list[int]] = {number: [] for number in numbers}
    for kind, start, stop in records(memoryview(data), 0, len(data)):
        if kind == MESSAGE and stop - start >= 22:
            number = data[start] | data[start + 1] << 8
            if number in found:
                found[number].append(start - 9)
    return {number: np.array(starts, dtype=np.int64) for number, starts in found.items()}


def _decode_loose(
    view: memoryview, places: Sequence[tuple[int, int]], readers: Mapping[int, MessageReader]
) -> dict[int, _Part]:
    """Decode the messages of a file without chunks."""
    raw = np.frombuffer(view, dtype=np.uint8)
    offsets: dict[int, list[int]] = {}
    for start, stop in places:
        if stop - start >= 22:
            offsets.setdefault(struct.unpack_from("<H", view, start)[0], []).append(start - 9)
    return {
        number: _decode_messages(raw, np.array(offsets[number], dtype=np.int64), reader)
        for number, reader in readers.items()
        if number in offsets
    }


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


def _decode_messages(raw: np.ndarray, offsets: np.ndarray, reader: MessageReader) -> _Part:
    if not len(offsets):
        return _Part(np.zeros(0, dtype=np.uint32), np.zeros(0, dtype=np.int64), {})
    prefix = _items(raw, offsets, _PREFIX)
    lengths = prefix["length"].astype(np.int64) - 22
    pieces: list[tuple[np.ndarray, Values]] = []
    for length in np.unique(lengths):
        rows = np.flatnonzero(lengths == length)
        pieces += decode_block(_blocks(raw, offsets[rows] + _PREFIX.itemsize, int(length)), rows, reader)
    return _Part(prefix["sequence"].copy(), prefix["log"].copy(), assembled(len(offsets), pieces))


def _joined(parts: Sequence[_Part]) -> Decoded:
    """Join the batches of one channel."""
    parts = [part for part in parts if len(part.sequence)]
    if not parts:
        return Decoded(np.zeros(0, dtype=np.uint32), np.zeros(0, dtype=np.int64), {})
    if all(part.values.keys() == parts[0].values.keys() for part in parts):
        values = {run: np.concatenate([part.values[run] for part in parts]) for run in parts[0].values}
    else:
        ends = np.cumsum([len(part.sequence) for part in parts])
        rows = [np.arange(end - len(part.sequence), end) for end, part in zip(ends, parts, strict=True)]
        values = assembled(int(ends[-1]), [(r, part.values) for r, part in zip(rows, parts, strict=True)])
    sequence = np.concatenate([part.sequence for part in parts])
    return Decoded(sequence, np.concatenate([part.log_ns for part in parts]), split(values))
