"""Records and chunks of a finished or truncated MCAP file, following the MCAP specification, version 0."""

from __future__ import annotations

import struct
import threading
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field

from armlab.errors import LogError

_MAX_CHUNK = 1 << 31  # bytes, maximum size of a valid chunk
_MAX_OPEN = 1 << 28  # bytes, maximum size of an unfinished chunk
_UNPACKED, _RATIO = 1 << 24, 200  # bytes that are always allowed; maximum expansion ratio above that (zstd: 15 000)
_PIECE = 1 << 20
_REPEATED, _RESERVED = 1, 3  # kinds of zstd blocks
_of_thread = threading.local()


@dataclass(slots=True)
class Chunk:
    """Chunk of messages, with the byte ranges [start, stop) of its record, its data and the index entries of each
    channel.

    `is_open`: the writer crashed before it wrote the times, the size and the checksum.
    """

    start: int
    stop: int
    first_ns: int
    last_ns: int
    size: int
    crc: int
    compression: str
    data: tuple[int, int]
    indexes: dict[int, tuple[int, int]] = field(default_factory=dict)
    is_open: bool = False


def most_unpacked(size: int) -> int:
    """Return the limit on the total unpacked size of the chunks in a file [bytes]."""
    return max(_UNPACKED, _RATIO * size)


def end_of_blocks(view: memoryview, at: int) -> int:
    """Return the end of the last complete block of the zstd frame at `at`, or `at` itself if no block is complete."""
    import zstandard

    header = bytes(view[at : at + 18])
    try:
        zstandard.get_frame_parameters(header)  # frame_content_size does not check the magic number
        start = at + zstandard.frame_header_size(header)
    except zstandard.ZstdError as error:
        raise LogError(f"Expected zstd data at byte {at}, got: {error}.") from None
    end, is_last = at, False
    while not is_last and start + 3 <= len(view):
        block = int.from_bytes(view[start : start + 3], "little")  # RFC 8878, 3.1.1.2: last, type, size
        is_last = bool(block & 1)
        kind, size = block >> 1 & 3, block >> 3
        start += 3 + (1 if kind == _REPEATED else size)
        if start > len(view) or kind == _RESERVED:
            break
        end = start
    return end


def unpacked(view: memoryview, chunk: Chunk) -> bytes:
    start, stop = chunk.data
    most = min(_MAX_OPEN if chunk.is_open else _MAX_CHUNK, most_unpacked(len(view)))
    if chunk.is_open:
        return _unpacked_open(bytes(view[start:stop]), most)
    if chunk.size > most:
        raise LogError(f"Expected a chunk of at most {most} bytes at byte {chunk.start}, got {chunk.size}.")
    data = _decompressed(view[start:stop], chunk)
    if len(data) != chunk.size:
        raise LogError(f"Expected {chunk.size} bytes in the chunk at byte {chunk.start}, got {len(data)}.")
    if chunk.crc and zlib.crc32(data) != chunk.crc:
        raise LogError(f"Expected checksum {chunk.crc:08x} of the chunk at byte {chunk.start}, got a different one.")
    return data


def _unpacked_open(packed: bytes, most: int) -> bytes:
    """Return the complete records in the blocks of an unfinished zstd frame, up to about `most` bytes."""
    import zstandard

    pieces, size = [], 0
    try:
        with zstandard.ZstdDecompressor().stream_reader(packed) as reader:
            while size < most and (piece := reader.read(_PIECE)):
                pieces.append(piece)
                size += len(piece)
    except zstandard.ZstdError:  # keep the bytes read so far
        pass
    data = b"".join(pieces)
    end = 0
    while end + 9 <= len(data):
        length = int.from_bytes(data[end + 1 : end + 9], "little")
        if length > len(data) - end - 9:
            break
        end += 9 + length
    return data[:end]


def _decompressed(packed: memoryview, chunk: Chunk) -> bytes:
    if chunk.compression == "":
        return bytes(packed)
    try:
        if chunk.compression == "zstd":
            import zstandard

            declared = zstandard.frame_content_size(packed)
            if declared not in (-1, chunk.size):  # checked before memory is allocated
                raise LogError(f"Expected {chunk.size} bytes in the chunk at byte {chunk.start}, got {declared}.")
            if not hasattr(_of_thread, "decompressor"):  # cached: its tables are as large as a chunk
                _of_thread.decompressor = zstandard.ZstdDecompressor()
            return _of_thread.decompressor.decompress(packed, max_output_size=chunk.size)
        if chunk.compression == "lz4":
            import lz4.frame

            return lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=chunk.size + 1)
    except LogError:
        raise
    except ImportError:
        raise LogError(
            "Expected the package lz4 for this file, but it is not installed. Install it: pip install lz4."
        ) from None
    except Exception as error:  # codec errors have no common base class
        raise LogError(f"Expected {chunk.compression} data in the chunk at byte {chunk.start}, got: {error}.") from None
    raise LogError(f"Expected compression zstd, lz4 or none, got {chunk.compression!r} at byte {chunk.start}.")


MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = range(9, 16)
_FOOTER_SIZE = 9 + 20
_MESSAGE = struct.Struct("<HIQQ")
OPEN = (1 << 64) - 1
"""Value of the length fields of an unfinished chunk."""
_PRIVATE = 128  # first record kind that is private to the writer

# Exceptions raised by reading corrupt bytes.
DAMAGE = (
    struct.error, UnicodeDecodeError, ValueError, IndexError, KeyError, OverflowError, MemoryError, RecursionError,
    LogError,
)  # fmt: skip


@dataclass(slots=True)
class Channel:
    """Channel: topic, type, schema and its encoding, message encoding, and a map of strings.

    Schema bytes that are not UTF-8, as in protobuf, are escaped as surrogates.
    """

    topic: str
    type: str
    schema: str
    schema_encoding: str
    encoding: str
    metadata: dict[str, str]


@dataclass(slots=True)
class Attached:
    """Attachment: name, media type, time, and the byte range [start, stop) of its data."""

    name: str
    media_type: str
    log_ns: int
    data: tuple[int, int]


@dataclass(slots=True)
class Contents:
    """Content of an MCAP file.

    `finished`: the file ends with a footer. `torn`: number of bytes after the last complete record. `indexed`: the
    chunk indexes list every message. `loose`: positions of messages outside chunks. `damaged`: kind of each skipped
    record, and the reason.
    """

    finished: bool = False
    indexed: bool = False
    torn: int = 0
    profile: str = ""
    library: str = ""
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[Chunk] = field(default_factory=list)
    attachments: list[Attached] = field(default_factory=list)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    loose: list[tuple[int, int]] = field(default_factory=list)
    damaged: list[tuple[int, str]] = field(default_factory=list)
    _schemas: dict[int, tuple[str, str, str]] = field(default_factory=dict)


def contents(view: memoryview) -> Contents:
    """Return the content, from the summary if it is intact, otherwise record by record."""
    if bytes(view[: len(MAGIC)]) != MAGIC:
        raise LogError(f"Expected an MCAP file, got a file that begins with {bytes(view[:8]).hex(' ') or 'no bytes'}.")
    try:
        found = _by_summary(view)
    except DAMAGE:
        found = None
    return found or _by_walking(view)


def records(view: memoryview, at: int, stop: int) -> Iterator[tuple[int, int, int]]:
    """Yield (kind, start, stop) for the body of each record that is completely within [at, stop)."""
    while at + 9 <= stop:
        kind, length = struct.unpack_from("<BQ", view, at)
        body = at + 9
        if length > stop - body:
            return
        yield kind, body, body + length
        at = body + length


def _by_summary(view: memoryview) -> Contents | None:
    """Return the content from an intact summary section, or None."""
    end = len(view) - len(MAGIC) - _FOOTER_SIZE
    if end < len(MAGIC) or bytes(view[-len(MAGIC) :]) != MAGIC or view[end] != FOOTER:
        return None
    start, _, crc = struct.unpack_from("<QQI", view, end + 9)
    if not (0 < start < end) or not crc or zlib.crc32(view[start : end + 9 + 16]) != crc:
        return None
    found = Contents(finished=True)
    chunk_count = None
    for kind, body, stop in records(view, start, end):
        if kind in (SCHEMA, CHANNEL):
            _register(found, view, kind, body, stop)
        elif kind == CHUNK_INDEX:
            found.chunks.append(_indexed_chunk(view, body))
        elif kind in (ATTACHMENT_INDEX, METADATA_INDEX):
            at = struct.unpack_from("<Q", view, body)[0] + 9
            _take(found, view, ATTACHMENT if kind == ATTACHMENT_INDEX else METADATA, at, len(view))
        elif kind == STATISTICS:
            (chunk_count,) = struct.unpack_from("<I", view, body + 22)
    header = next(records(view, len(MAGIC), len(view)), None)
    if header is not None:  # otherwise, the header length is corrupt, but the summary is intact
        _take(found, view, HEADER, *header[1:])
    whole = found.channels and found.chunks and chunk_count == len(found.chunks)
    found.indexed = all(chunk.indexes for chunk in found.chunks)
    _check_sizes(found, view)
    return found if whole else None


def _by_walking(view: memoryview) -> Contents:
    """Return the content record by record; corrupt records are skipped and listed."""
    found = Contents()
    at = len(MAGIC)
    for kind, body, stop in records(view, at, len(view)):
        if body == at + 9 == len(MAGIC) + 9 and kind != HEADER:
            raise LogError(f"Expected the header of an MCAP file, got a record of kind {kind}.")
        try:
            _take(found, view, kind, body, stop)
        except DAMAGE as error:
            found.damaged.append((kind, f"record of kind {kind} at byte {body - 9} skipped: {error}"))
            continue
        finally:
            at = stop
        if kind == FOOTER:
            found.finished = bytes(view[stop : stop + len(MAGIC)]) == MAGIC
            break
    if not found.finished:
        found.torn = len(view) - _open_chunk(found, view, at)
    _check_sizes(found, view)
    _find_channels(found, view)
    return found


def _check_sizes(found: Contents, view: memoryview) -> None:
    """Raise an error if all chunks together unpack to far more than the file size; ignore single oversized chunks."""
    most = most_unpacked(len(view))
    whole = sum(chunk.size for chunk in found.chunks if chunk.size <= most)
    if whole > most:
        raise LogError(
            f"Expected chunks that unpack to at most {most} bytes, got {whole} in a file of {len(view)}. If you trust "
            "the file, rewrite it without compression: mcap compress --compression none."
        )


def _open_chunk(found: Contents, view: memoryview, at: int) -> int:
    """Add the chunk at this position if it is unfinished; return the end of the readable part of the file."""
    try:
        kind, length = struct.unpack_from("<BQ", view, at)
        compression, data = _text(view, at + 9 + 28)
        (packed,) = struct.unpack_from("<Q", view, data)
        if (kind, length, packed, compression) != (CHUNK, OPEN, OPEN, "zstd"):
            return at
        stop = end_of_blocks(view, data + 8)
    except DAMAGE:
        return at
    found.chunks.append(Chunk(at, stop, 0, 0, 0, 0, compression, (data + 8, stop), is_open=True))
    return stop


def _take(found: Contents, view: memoryview, kind: int, body: int, stop: int) -> None:
    if kind == HEADER:
        found.profile, at = _text(view, body)
        found.library, _ = _text(view, at)
    elif kind in (SCHEMA, CHANNEL):
        number = int.from_bytes(view[body : body + 2], "little")
        if number not in (found._schemas if kind == SCHEMA else found.channels):  # otherwise, the summary repeats it
            _register(found, view, kind, body, stop)
    elif kind == CHUNK:
        found.chunks.append(_chunk(view, body, stop))
    elif kind == MESSAGE_INDEX and found.chunks:
        channel, length = struct.unpack_from("<HI", view, body)
        if length == stop - body - 6:
            found.chunks[-1].indexes[channel] = (body + 6, stop)
    elif kind == ATTACHMENT:
        found.attachments.append(_attachment(view, body))
    elif kind == METADATA:
        name, at = _text(view, body)
        found.metadata[name] = _map(view, at, len(view))
    elif kind == MESSAGE:
        found.loose.append((body, stop))
    elif kind == 0 or DATA_END < kind < _PRIVATE:  # the first byte is corrupt
        raise LogError(f"Expected a record kind from {HEADER} to {DATA_END}, got {kind}.")


def _find_channels(found: Contents, view: memoryview) -> None:
    """Read the schemas and channels from the chunks, because the file has no summary that contains them."""
    used = {channel for chunk in found.chunks for channel in chunk.indexes}
    for number, chunk in enumerate(found.chunks):
        if number and used and used <= found.channels.keys():
            return
        try:
            data = memoryview(unpacked(view, chunk))
            for kind, body, stop in records(data, 0, len(data)):
                if kind in (SCHEMA, CHANNEL):
                    _register(found, data, kind, body, stop)
        except DAMAGE:
            continue


def _register(found: Contents, view: memoryview, kind: int, body: int, stop: int) -> None:
    if kind == SCHEMA:
        (number,) = struct.unpack_from("<H", view, body)
        name, at = _text(view, body + 2)
        encoding, at = _text(view, at)
        text, _ = _text(view, at, "surrogateescape")
        found._schemas[number] = (name, text, encoding)
        return
    number, schema = struct.unpack_from("<HH", view, body)
    topic, at = _text(view, body + 4)
    encoding, at = _text(view, at)
    description = found._schemas.get(schema, ("", "", ""))
    found.channels[number] = Channel(topic, *description, encoding, _map(view, at, stop))


def _chunk(view: memoryview, body: int, stop: int) -> Chunk:
    first, last, size, crc = struct.unpack_from("<QQQI", view, body)
    compression, at = _text(view, body + 28)
    (length,) = struct.unpack_from("<Q", view, at)
    if at + 8 + length != stop:
        raise LogError(f"Expected a chunk of {stop - at - 8} bytes at byte {body}, got {length}.")
    return Chunk(body - 9, stop, first, last, size, crc, compression, (at + 8, stop))


def _indexed_chunk(view: memoryview, body: int) -> Chunk:
    _, _, start, length, size = struct.unpack_from("<QQQQI", view, body)
    chunk = _chunk(view, start + 9, start + length)
    for at in range(body + 36, body + 36 + size, 10):
        channel, place = struct.unpack_from("<HQ", view, at)
        kind, length, _, entries = struct.unpack_from("<BQHI", view, place)
        if kind != MESSAGE_INDEX or entries + 6 != length or entries % 16:
            raise LogError(f"Expected a message index at byte {place}, got a record of kind {kind}.")
        chunk.indexes[channel] = (place + 15, place + 15 + entries)
    return chunk


def _attachment(view: memoryview, body: int) -> Attached:
    name, at = _text(view, body + 16)
    media_type, at = _text(view, at)
    (length,) = struct.unpack_from("<Q", view, at)
    if at + 8 + length > len(view):
        raise LogError(f"Expected an attachment of {length} bytes at byte {body}, got the end of the file.")
    (log_ns,) = struct.unpack_from("<Q", view, body)
    return Attached(name, media_type, log_ns, (at + 8, at + 8 + length))


def _text(view: memoryview, at: int, errors: str = "strict") -> tuple[str, int]:
    (length,) = struct.unpack_from("<I", view, at)
    at += 4
    if length > len(view) - at:
        raise LogError(f"Expected a string of {length} bytes at byte {at}, got the end of the file.")
    return bytes(view[at : at + length]).decode(errors=errors), at + length


def _map(view: memoryview, at: int, stop: int) -> dict[str, str]:
    (length,) = struct.unpack_from("<I", view, at)
    at += 4
    end = at + length
    if end > stop:
        raise LogError(f"Expected a map of {length} bytes at byte {at}, got the end of the record.")
    pairs = {}
    while at < end:
        key, at = _text(view, at)
        pairs[key], at = _text(view, at)
    return pairs


def pieces(found: Contents) -> list[Chunk | None]:
    """Return the chunks of a file in reading order, then None for messages outside chunks."""
    return [*found.chunks, *([None] if found.loose else [])]


def records_at(view: memoryview, found: Contents, piece: Chunk | None) -> bytes | None:
    """Return the records of a chunk, or None if it is corrupt."""
    if piece is None:
        return b"".join(bytes(view[start - 9 : stop]) for start, stop in found.loose)
    try:
        return unpacked(view, piece)
    except LogError:
        return None


def messages_in(data: bytes | None) -> Iterator[tuple[int, int, int, int, bytes]]:
    """Yield (channel, sequence, log time, publish time, message) of the messages in the records, if any."""
    data = data or b""
    for kind, start, stop in records(memoryview(data), 0, len(data)):
        if kind == MESSAGE and stop - start >= _MESSAGE.size:
            yield (*_MESSAGE.unpack_from(data, start), data[start + _MESSAGE.size : stop])
