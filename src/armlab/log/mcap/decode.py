"""Numeric columns of MCAP messages, decoded in blocks of rows that share a layout.

The chunk indexes give the number of messages. The first message of a channel is parsed field by field. Messages with
the same length and the same non-numeric bytes have the same layout. The numeric values of messages with the same layout
are copied chunk by chunk into arrays of the final size (`Room`). Messages with other layouts are read in blocks of
equal length (`decode_messages`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from textwrap import shorten

import numpy as np

from armlab.errors import LogError
from armlab.kernels import MessageCopier
from armlab.log.column import refuse_ragged
from armlab.log.file_formats.description import Progress
from armlab.log.mcap.records import DAMAGE, MESSAGE, Chunk, Contents, messages_in, pieces, records, records_at, unpacked
from armlab.wire import cdr

_MAX_VARIANTS = 8  # cached layouts per channel and length; messages whose strings always differ are read one by one

# Consecutive numbers of one type in a message: path and count of each field.
Run = tuple[tuple[str, int], ...]
Values = dict[Run, np.ndarray]
Piece = tuple[np.ndarray, Values]
"""Rows (k,) of messages, and their numeric values (k, count)."""


@dataclass(slots=True)
class Variant:
    """Layout of messages with equal length and equal bytes in the ranges `fixed`; `runs`: start, stop and type of each
    run of numbers."""

    first: np.ndarray
    fixed: list[tuple[int, int]]
    runs: dict[Run, tuple[int, int, str]]

    def numbers(self, block: np.ndarray) -> Values:
        """Return the numeric values (k, count) of messages (k, length), in the machine's byte order."""
        found = {}
        for run, (start, stop, dtype) in self.runs.items():
            array = block[:, start:stop].copy().view(dtype)  # the block's memory is reused
            found[run] = array.astype(array.dtype.newbyteorder("="), copy=False)
        return found


@dataclass(slots=True)
class MessageReader:
    """Requested fields of one channel (None: all), the function that names its numbers, and the cached layouts."""

    type: str
    types: cdr.Definitions
    wanted: frozenset[str] | None
    named: Callable[[cdr.Layout], Sequence[cdr.Field]] | None = None
    variants: dict[int, list[Variant]] = field(default_factory=dict)


@dataclass(slots=True)
class Read:
    """Rows (k,) and numeric values of the valid messages, grouped by layout; the number of invalid messages; the reason
    why the first one is invalid."""

    rows: np.ndarray
    pieces: list[Piece]
    bad: int
    reason: str


@dataclass(slots=True)
class _Bad:
    """Rows of invalid messages, and the reason why the first one is invalid."""

    rows: list[int] = field(default_factory=list)
    first: int = 0
    reason: str = ""

    def add(self, row: int, reason: str) -> None:
        if not self.rows or row < self.first:
            self.first, self.reason = row, reason
        self.rows.append(row)


def of_length(lengths: np.ndarray) -> list[np.ndarray]:
    """Return, for each message length, the rows (k,) of the messages of that length, in increasing order."""
    order = np.argsort(lengths, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(lengths[order])) + 1) if len(order) else []


def read_blocks(count: int, blocks: Iterable[tuple[np.ndarray, np.ndarray]], reader: MessageReader) -> Read:
    """Read groups of messages of equal length, given as rows (k,) and bytes (k, length); parse only new layouts."""
    pieces: list[Piece] = []
    bad = _Bad()
    for rows, block in blocks:
        pieces += _read_block(block, rows, reader, bad)
    rows = np.arange(count)
    if bad.rows:
        rows = np.delete(rows, bad.rows)
        pieces = [(np.searchsorted(rows, piece), values) for piece, values in pieces]
    few = len(pieces) <= _MAX_VARIANTS
    return Read(rows, pieces if few else joined(pieces), len(bad.rows), bad.reason)


def _read_block(block: np.ndarray, rows: np.ndarray, reader: MessageReader, bad: _Bad) -> Iterator[Piece]:
    """Yield (rows, numbers) of messages of equal length, layout by layout; add invalid messages to `bad`."""
    known = reader.variants.setdefault(block.shape[1], [])
    for variant in list(known):
        same = _same(block, variant)
        if same.any():
            yield rows[same], variant.numbers(block[same] if not same.all() else block)
            block, rows = block[~same], rows[~same]
        if not len(block):
            return
    while len(block):
        try:
            variant = variant_of(block[0], reader)
        except DAMAGE as error:
            bad.add(int(rows[0]), str(error) or type(error).__name__)
            block, rows = block[1:], rows[1:]
            continue
        if len(known) < _MAX_VARIANTS:
            known.append(variant)
            same = _same(block, variant)
            yield rows[same], variant.numbers(block[same])
            block, rows = block[~same], rows[~same]
        else:  # one by one, because comparing all pairs would take quadratic time
            yield rows[:1], variant.numbers(block[:1])
            block, rows = block[1:], rows[1:]


def _same(block: np.ndarray, variant: Variant) -> np.ndarray:
    """Return the mask (k,) of messages that match the layout in all bytes that are not numeric."""
    same = np.ones(len(block), dtype=bool)
    for start, stop in variant.fixed:
        equal = block[:, start:stop] == variant.first[start:stop]
        if not equal.all():
            same &= equal.all(axis=1)
    return same


def variant_of(first: np.ndarray, reader: MessageReader) -> Variant:
    """Split one message into the non-numeric bytes and runs of the requested numbers."""
    raw = first.tobytes()
    found = cdr.layout(raw, reader.type, reader.types)
    fixed, at = [], 0
    for start, stop in [*((f.start, f.stop) for f in found.fields), (len(raw), len(raw))]:
        if start > at:
            fixed.append((at, start))
        at = stop
    fields = reader.named(found) if reader.named else found.fields
    wanted = (f for f in fields if f.count and (reader.wanted is None or f.path in reader.wanted))
    return Variant(np.frombuffer(raw, dtype=np.uint8), fixed, dict(_runs(wanted)))


def _runs(fields: Iterable[cdr.Field]) -> Iterator[tuple[Run, tuple[int, int, str]]]:
    """Yield runs of consecutive numbers of one type, with start, stop and type."""
    run: list[tuple[str, int]] = []
    start, stop, dtype = 0, 0, ""
    for one in fields:
        if run and (one.start != stop or one.dtype != dtype):
            yield tuple(run), (start, stop, dtype)
            run = []
        if not run:
            start, dtype = one.start, one.dtype
        run.append((one.path, one.count))
        stop = one.stop
    if run:
        yield tuple(run), (start, stop, dtype)


def joined(pieces: Iterable[Piece]) -> list[Piece]:
    """Merge pieces with the same columns, in order of first occurrence."""
    alike: dict[tuple[Run, ...], list[Piece]] = {}
    for piece in pieces:
        alike.setdefault(tuple(piece[1]), []).append(piece)
    return [
        one[0]
        if len(one) == 1
        else (
            np.concatenate([rows for rows, _ in one]),
            {run: np.concatenate([values[run] for _, values in one]) for run in runs},
        )
        for runs, one in alike.items()
    ]


def assembled(count: int, pieces: Sequence[Piece]) -> dict[str, np.ndarray]:
    """Assemble the numeric values of several layouts by dotted name; fields that a layout lacks are NaN."""
    if len(pieces) == 1 and np.array_equal(pieces[0][0], np.arange(count)):
        return _split(pieces[0][1])
    if all(found.keys() == pieces[0][1].keys() for _, found in pieces):
        runs = pieces[0][1] if pieces else ()
        return _split({run: _filled(count, [(rows, found[run]) for rows, found in pieces]) for run in runs})
    parts: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    for rows, found in pieces:
        for path, array in _split(found).items():
            parts.setdefault(path, []).append((rows, array))
    widths = {path: max(array.shape[1] for _, array in held) for path, held in parts.items()}
    refuse_ragged(count, widths, sum(array.size for held in parts.values() for _, array in held))
    return {path: _filled(count, held) for path, held in parts.items()}


def _filled(count: int, parts: Sequence[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Assemble arrays (k, width) by row into one array (count, largest width) with NaN elsewhere."""
    width = max(array.shape[1] for _, array in parts)
    whole = sum(len(rows) for rows, _ in parts) == count and all(array.shape[1] == width for _, array in parts)
    kind = np.result_type(*{array.dtype for _, array in parts})  # integers with missing values are already floats
    target = np.empty((count, width), kind) if whole else np.full((count, width), np.nan)
    for rows, array in parts:
        target[rows, : array.shape[1]] = array
    return target


def _split(values: Values) -> dict[str, np.ndarray]:
    """Return the numeric values of each field path, extracted from the runs of consecutive numbers."""
    fields = {}
    for run, array in values.items():
        at = 0
        for path, count in run:
            fields[path] = array[:, at : at + count]
            at += count
    return fields


_PREFIX = np.dtype(
    [("kind", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("log", "<i8"), ("publish", "<i8")]
)


@dataclass(slots=True)
class Part:
    """Messages of one channel in part of a file: sequence numbers (k,), log times (k,) and numeric values by layout.

    `bad`: number of messages that do not match their type; `reason`: why the first one does not match.
    """

    sequence: np.ndarray
    log_ns: np.ndarray
    pieces: Sequence[Piece] = ()
    bad: int = 0
    reason: str = ""


def decode_chunk(
    view: memoryview, chunk: Chunk, data: bytes, readers: Mapping[int, MessageReader], indexed: bool
) -> dict[int, Part]:
    """Return the messages in a chunk by channel; without complete indexes, its records are parsed one by one."""
    raw = np.frombuffer(data, dtype=np.uint8)
    offsets = {}
    for number in readers if indexed else ():
        start, stop = chunk.indexes.get(number, (0, 0))
        offsets[number] = np.frombuffer(view[start:stop], dtype="<i8")[1::2]
        indexed = indexed and _are_messages(raw, offsets[number], number)
    if not indexed:
        offsets = walked(data, readers)
    return {number: decode_messages(raw, offsets[number], reader) for number, reader in readers.items()}


def _are_messages(raw: np.ndarray, offsets: np.ndarray, number: int) -> bool:
    """Return whether complete messages of the channel begin at the offsets, which must increase."""
    if not len(offsets):
        return True
    if offsets[0] < 0 or offsets[-1] > len(raw) - _PREFIX.itemsize or (np.diff(offsets) <= 0).any():
        return False
    prefix = _items(raw, offsets, _PREFIX)
    length = prefix["length"]
    fits = (length >= 22) & (length <= len(raw)) & (offsets + 9 + length.astype(np.int64) <= len(raw))
    return bool((fits & (prefix["kind"] == MESSAGE) & (prefix["channel"] == number)).all())


def walked(data: bytes, numbers: Collection[int]) -> dict[int, np.ndarray]:
    """Return the message offsets of the given channels by parsing the records."""
    found: dict[int, list[int]] = {number: [] for number in numbers}
    for kind, start, stop in records(memoryview(data), 0, len(data)):
        if kind == MESSAGE and stop - start >= 22:
            number = data[start] | data[start + 1] << 8
            if number in found:
                found[number].append(start - 9)
    return {number: np.array(starts, dtype=np.int64) for number, starts in found.items()}


def _items(raw: np.ndarray, offsets: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """Read items (k,) of one data type at arbitrary offsets."""
    places = max(len(raw) - dtype.itemsize + 1, 0)
    return np.ndarray((places,), dtype=dtype, buffer=raw, strides=(1,))[offsets]


def _blocks(raw: np.ndarray, offsets: np.ndarray, length: int) -> np.ndarray:
    """Read blocks of bytes (k, length) at the offsets."""
    found = _items(raw, offsets, np.dtype((np.void, length))) if length else np.zeros(len(offsets), np.uint8)
    return found.view(np.uint8).reshape(len(offsets), -1)[:, :length]


def decode_messages(raw: np.ndarray, offsets: np.ndarray, reader: MessageReader) -> Part:
    """Return the messages whose records begin at the offsets (k,) of a byte array."""
    if not len(offsets):
        return Part(np.zeros(0, dtype=np.uint32), np.zeros(0, dtype=np.int64))
    prefix = _items(raw, offsets, _PREFIX)
    lengths = prefix["length"].astype(np.int64) - 22
    same = of_length(lengths)
    blocks = ((rows, _blocks(raw, offsets[rows] + _PREFIX.itemsize, int(lengths[rows[0]]))) for rows in same)
    read = read_blocks(len(offsets), blocks, reader)
    return Part(prefix["sequence"][read.rows], prefix["log"][read.rows], read.pieces, read.bad, read.reason)


_RECORD = 31  # bytes of a record before its message: kind, length, channel, sequence, two times
_LARGEST = 1 << 31  # bytes, maximum size of a valid chunk
_TRIES = 8  # chunks searched for the first message of each channel


class Room:
    """Preallocated arrays for the messages of the given channels."""

    def __init__(self, view: memoryview, chunks: Sequence[Chunk], readers: Mapping[int, MessageReader]) -> None:
        self._columns: dict[int, _Columns] = {}
        messages = _first_messages(view, chunks, readers)
        for number, reader in readers.items():
            places = np.array([chunk.indexes.get(number, (0, 0)) for chunk in chunks], dtype=np.int64).reshape(-1, 2)
            count = (places[:, 1] - places[:, 0]) // 16  # messages per chunk, from the index
            message = messages.get(number, b"")
            if message or not count.any():
                with suppress(*DAMAGE):  # corrupt messages, and sizes that exceed memory
                    self._columns[number] = _columns(chunks, count, message, reader)
        columns = self._columns.values()
        self._first = list(zip(*(one.first for one in columns), strict=True)) or [()] * len(chunks)
        self._count = list(zip(*(one.count for one in columns), strict=True)) or [()] * len(chunks)
        self._copier = MessageCopier(
            [
                (number, one.message, one.fixed, one.places, one.sequence, one.log_ns, list(one.numbers.values()))
                for number, one in self._columns.items()
            ]
        )

    def copy(self, place: int, data: bytes) -> dict[int, range]:
        """Copy the messages of a chunk, and return the rows of the channels whose messages have a single layout."""
        first, count = self._first[place], self._count[place]
        copied = self._copier.copy(data, first, count)
        return {
            number: range(row, row + rows)
            for number, row, rows, whole in zip(self._columns, first, count, copied, strict=True)
            if whole
        }

    def part(self, number: int, rows: range) -> Part:
        """Return rows of a channel as read-only arrays, because a table uses them without a copy."""
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
    """Arrays of one channel, with an example message, its offsets, and first row and count per chunk (-1: invalid)."""

    first: list[int]
    count: list[int]
    message: bytes
    fixed: Sequence[tuple[int, int]]
    places: Sequence[tuple[int, int]]
    sequence: np.ndarray
    log_ns: np.ndarray
    numbers: dict[str, np.ndarray]


def _columns(chunks: Sequence[Chunk], count: np.ndarray, message: bytes, reader: MessageReader) -> _Columns:
    """Return arrays for `count` messages per chunk with the layout of an example message."""
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
    """Return the first message of each channel that occurs in the first chunks."""
    found: dict[int, bytes] = {}
    for chunk in [one for one in chunks if one.indexes.keys() & set(channels)][:_TRIES]:
        missing = chunk.indexes.keys() & set(channels) - found.keys()
        with suppress(LogError):
            for number, *_, message in messages_in(unpacked(view, chunk) if missing else None):
                if number in missing:
                    found[number] = message
                    missing.discard(number)
                if not missing:
                    break
    return found


_BATCH = 8  # chunks per reader-thread task


@dataclass(slots=True)
class Decoded:
    """Messages of one channel: sequence and log time (N,), and fields (N, count) by dotted name, NaN if missing."""

    sequence: np.ndarray
    log_ns: np.ndarray
    fields: dict[str, np.ndarray]


def decode(
    view: memoryview, found: Contents, wanted: Mapping[int, Sequence[str]], progress: Progress | None = None
) -> tuple[dict[int, Decoded], list[str]]:
    """Return the requested fields of the channels, and a note on each corrupt chunk or channel.

    `wanted`: channel -> dotted names of fields.
    """
    readers = {}
    for number, paths in wanted.items():
        channel = found.channels[number]
        if channel.encoding != "cdr":
            raise LogError(f"Expected messages encoded as cdr on {channel.topic}, got {channel.encoding!r}.")
        types = cdr.definitions(channel.type, channel.schema)
        readers[number] = MessageReader(channel.type, types, frozenset(paths))
    return decode_by(view, found, readers, progress)


def decode_by(
    view: memoryview, found: Contents, readers: Mapping[int, MessageReader], progress: Progress | None = None
) -> tuple[dict[int, Decoded], list[str]]:
    """Return the messages of each channel as decoded by its reader, and a note on each corrupt chunk or channel."""
    chunks = [chunk for chunk in found.chunks if not found.indexed or chunk.indexes.keys() & readers.keys()]
    room = Room(view, chunks, readers)

    def read(places: range) -> tuple[dict[int, list[range | Part]], list[str]]:
        """Read the given chunks; return preallocated rows and other messages by channel, and the corrupt chunks."""
        held: dict[int, list[range | Part]] = {number: [] for number in readers}
        damage = []
        for place in places:
            chunk = chunks[place]
            try:
                data = unpacked(view, chunk)
            except LogError as error:
                damage.append(f"chunk at byte {chunk.start} skipped: {error}")
                continue
            copied = room.copy(place, data)
            others = {number: reader for number, reader in readers.items() if number not in copied}
            parts = decode_chunk(view, chunk, data, others, found.indexed) if others else {}
            for number, part in (*copied.items(), *parts.items()):
                held[number].append(part)
        return held, damage

    parts: dict[int, list[range | Part]] = {number: [] for number in readers}
    damage: list[str] = []
    batches = [range(first, min(first + _BATCH, len(chunks))) for first in range(0, len(chunks), _BATCH)]
    done, total = 0, sum(chunk.size for chunk in chunks)
    with ThreadPoolExecutor(2) as pool:  # decompression, checksums and copies release the GIL
        for batch, (decoded, lost) in zip(batches, pool.map(read, batches), strict=True):
            damage += lost
            for number, of_channel in decoded.items():
                parts[number] += of_channel
            done += sum(chunk.size for chunk in chunks[batch.start : batch.stop])
            if progress:
                progress(done, total, "bytes")
    if found.loose:
        data = records_at(view, found, None) or b""
        for number, offsets in walked(data, readers).items():
            parts[number].append(decode_messages(np.frombuffer(data, dtype=np.uint8), offsets, readers[number]))
    whole: dict[int, Decoded] = {}
    for number, of_channel in parts.items():
        whole[number], bad, reason = _decoded(room, number, of_channel)
        if bad:
            damage.append(skipped(bad, found.channels[number].topic, reason))
    return whole, damage


def skipped(count: int, topic: str, reason: str) -> str:
    """Return a note on skipped messages, with the reason for skipping the first one."""
    return f"{count} message{'s' if count > 1 else ''} on {topic} skipped: {shorten(reason, 300)}"


def messages(view: memoryview, found: Contents, channel: int) -> Iterator[tuple[int, int, bytes]]:
    """Yield (sequence, log time, message) of one channel, times as int64; corrupt chunks are skipped."""
    for piece in pieces(found):
        if piece is None or not found.indexed or channel in piece.indexes:
            for number, sequence, log_ns, _, message in messages_in(records_at(view, found, piece)):
                if number == channel:
                    yield sequence, log_ns - (log_ns >> 63 << 64), message


def message_counts(view: memoryview, found: Contents) -> Counter[int]:
    """Return the number of readable messages per channel."""
    counts: Counter[int] = Counter()
    for piece in pieces(found):
        if piece is not None and found.indexed:
            counts.update({number: (stop - start) // 16 for number, (start, stop) in piece.indexes.items()})
        else:
            counts.update(number for number, *_ in messages_in(records_at(view, found, piece)))
    return counts


def _decoded(room: Room, number: int, found: Sequence[range | Part]) -> tuple[Decoded, int, str]:
    """Join the parts of a channel; also return the number of skipped messages and the reason for skipping the first
    one."""
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
        fields = assembled(ends[-1], pieces)
    except LogError as error:
        return nothing, bad + ends[-1], str(error)
    sequence = np.concatenate([part.sequence for part in parts]) if len(parts) > 1 else parts[0].sequence
    log_ns = np.concatenate([part.log_ns for part in parts]) if len(parts) > 1 else parts[0].log_ns
    return Decoded(sequence, log_ns, fields), bad, reason
