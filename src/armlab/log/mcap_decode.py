"""Numbers out of the messages of an MCAP file, a chunk at a time and without building objects.

The first message of a channel is walked field by field. All messages of equal length whose bytes outside the numbers
are the same hold their numbers in the same places, so those of a whole chunk are copied at once, to where they stay.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from textwrap import shorten

import numpy as np

from armlab.errors import LogError
from armlab.log.description import Progress
from armlab.log.mcap_blocks import Part, decode_chunks, decode_messages, walked
from armlab.log.mcap_chunk import Chunk, unpacked
from armlab.log.mcap_columns import Room
from armlab.log.mcap_records import MESSAGE, Contents, records
from armlab.log.mcap_variants import MessageReader, assembled, split
from armlab.wire import cdr

__all__ = ["Decoded", "decode", "decode_by", "message_counts", "messages", "skipped"]

_BATCH = 2_000_000  # bytes of records read at once: amortises calls, stays in the cache of a core


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


def decode(
    view: memoryview, found: Contents, wanted: Mapping[int, Sequence[str]], progress: Progress | None = None
) -> tuple[dict[int, Decoded], list[str]]:
    """Return the wanted fields of the wanted channels, and one sentence per damaged chunk or channel.

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
    """Return what the readers of some channels read, and one sentence per damaged chunk or channel.

    Parameters
    ----------
    view, found, progress : as in `decode`. readers : by channel.
    """
    chunks = [chunk for chunk in found.chunks if not found.indexed or chunk.indexes.keys() & readers.keys()]
    reading = _Reading(view, chunks, readers, found.indexed, Room(view, chunks, readers))
    parts: dict[int, list[range | Part]] = {number: [] for number in readers}
    damage: list[str] = []
    batches, done, total = list(_batches(chunks)), 0, sum(chunk.size for chunk in chunks)
    with ThreadPoolExecutor(2) as pool:  # decompression, checksums and copies release the interpreter lock
        for batch, (decoded, lost) in zip(batches, pool.map(reading.batch, batches), strict=True):
            damage += lost
            for number, of_channel in decoded.items():
                parts[number] += of_channel
            done += sum(chunk.size for chunk in chunks[batch.start : batch.stop])
            if progress:
                progress(done, total, "bytes")
    if found.loose:
        for number, part in _decode_loose(view, found.loose, readers).items():
            parts[number].append(part)
    whole: dict[int, Decoded] = {}
    for number, of_channel in parts.items():
        whole[number], bad, reason = _decoded(reading.room, number, of_channel)
        if bad:
            damage.append(skipped(bad, found.channels[number].topic, reason))
    return whole, damage


def skipped(count: int, topic: str, reason: str) -> str:
    """Return the sentence on messages that are left out, and why the first of them is."""
    return f"{count} message{'s' if count > 1 else ''} on {topic} skipped: {shorten(reason, 300)}"


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
                number, sequence, log = struct.unpack_from("<HIq", data, start)
                if number == channel:
                    yield sequence, log, data[start + 22 : stop]
    for start, stop in found.loose:
        if stop - start >= 22:
            number, sequence, log = struct.unpack_from("<HIq", view, start)
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
            offsets = walked(unpacked(view, chunk), found.channels)
        except LogError:
            continue
        counts.update({number: len(places) for number, places in offsets.items()})
    counts.update(struct.unpack_from("<H", view, start)[0] for start, stop in found.loose if stop - start >= 22)
    return counts


def _batches(chunks: Sequence[Chunk]) -> Iterator[range]:
    """Yield the places of chunks that are read at once."""
    first, size = 0, 0
    for place, chunk in enumerate(chunks):
        size += chunk.size
        if size > _BATCH or place == len(chunks) - 1:
            yield range(first, place + 1)
            first, size = place + 1, 0


@dataclass(frozen=True, slots=True)
class _Reading:
    """The chunks of a file and the room that their messages are copied into."""

    view: memoryview
    chunks: Sequence[Chunk]
    readers: Mapping[int, MessageReader]
    indexed: bool
    room: Room

    def batch(self, places: range) -> tuple[dict[int, list[range | Part]], list[str]]:
        """Read some chunks; return rows of the room and other messages by channel, and the damaged chunks.

        From the first chunk on that the room does not take, a channel's messages are decoded layout by layout, those
        of several chunks at once.
        """
        found: dict[int, list[range | Part]] = {number: [] for number in self.readers}
        others: dict[int, list[tuple[Chunk, bytes]]] = {}
        damage = []
        for place in places:
            chunk = self.chunks[place]
            try:
                data = unpacked(self.view, chunk)
            except LogError as error:
                damage.append(f"chunk at byte {chunk.start} skipped: {error}")
                continue
            copied = self.room.copy(place, data)
            for number in self.readers:
                if number in copied and number not in others:
                    found[number].append(copied[number])
                else:
                    others.setdefault(number, []).append((chunk, data))
        for count in sorted({len(chunks) for chunks in others.values()}):  # equally many begin at the same chunk
            readers = {number: self.readers[number] for number, chunks in others.items() if len(chunks) == count}
            parts = decode_chunks(self.view, others[next(iter(readers))], readers, self.indexed)
            for number, part in parts.items():
                found[number].append(part)
        return found, damage


def _decode_loose(
    view: memoryview, places: Sequence[tuple[int, int]], readers: Mapping[int, MessageReader]
) -> dict[int, Part]:
    """Decode the messages of a file without chunks."""
    raw = np.frombuffer(view, dtype=np.uint8)
    offsets: dict[int, list[int]] = {}
    for start, stop in places:
        if stop - start >= 22:
            offsets.setdefault(struct.unpack_from("<H", view, start)[0], []).append(start - 9)
    return {
        number: decode_messages(raw, np.array(offsets[number], dtype=np.int64), reader)
        for number, reader in readers.items()
        if number in offsets
    }


def _decoded(room: Room, number: int, found: Sequence[range | Part]) -> tuple[Decoded, int, str]:
    """Join what was read of one channel; return also how many messages are left out, and why the first of them is."""
    merged: list[range | Part] = []
    for one in found:
        before = merged[-1] if merged else None
        if isinstance(one, range) and isinstance(before, range) and before.stop == one.start:
            merged[-1] = range(before.start, one.stop)
        else:
            merged.append(one)
    parts = [room.part(number, one) if isinstance(one, range) else one for one in merged]
    bad, reason = sum(part.bad for part in parts), next((part.reason for part in parts if part.bad), "")
    parts = [part for part in parts if len(part.sequence)]
    nothing = Decoded(np.zeros(0, dtype=np.uint32), np.zeros(0, dtype=np.int64), {})
    if not parts:
        return nothing, bad, reason
    ends = np.cumsum([len(part.sequence) for part in parts]).tolist()
    firsts = [end - len(part.sequence) for end, part in zip(ends, parts, strict=True)]
    pieces = [(rows + at, values) for at, part in zip(firsts, parts, strict=True) for rows, values in part.pieces]
    try:
        fields = split(assembled(ends[-1], pieces))
    except LogError as error:
        return nothing, bad + ends[-1], str(error)
    sequence = np.concatenate([part.sequence for part in parts]) if len(parts) > 1 else parts[0].sequence
    log_ns = np.concatenate([part.log_ns for part in parts]) if len(parts) > 1 else parts[0].log_ns
    return Decoded(sequence, log_ns, fields), bad, reason
