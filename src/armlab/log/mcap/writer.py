"""`McapWriter`: writes an MCAP file that is readable up to the last `push`, even after a crash.

The current chunk is already in the file. The chunk header marks the chunk as open (length 2^64 - 1, as in other
writers) and is followed by one zstd frame that grows block by block. Data passed to the kernel by `push` survives a
crash; `close_chunk` later overwrites the open header. The writer follows the MCAP specification, version 0.
"""

from __future__ import annotations

import contextlib
import errno
import os
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from itertools import chain
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, Protocol

from armlab._files import Descriptor
from armlab.log.mcap import records as kinds

_MESSAGE = struct.Struct("<BQHIQQ")
_MESSAGE_PREFIX = 22
_CHUNK = struct.Struct("<BQQQQII4sQ")  # record, times, size, checksum, "zstd", length of the data
_CHUNK_BODY = _CHUNK.size - 9
_OPENED = _CHUNK.pack(kinds.CHUNK, kinds.OPEN, 0, 0, 0, 0, 4, b"zstd", kinds.OPEN)
_ENTRY = struct.Struct("<QQ")
_KEPT = 2**16  # bytes of the chunk index kept in memory: five minutes of one arm


class _WritableFile(Protocol):
    """File interface used by the writer; `write` returns the number of bytes written."""

    def write(self, data: Any, /) -> int: ...

    def seek(self, at: int, /) -> int: ...

    def truncate(self, size: int, /) -> int: ...


@dataclass(slots=True)
class _OpenChunk:
    """Current chunk: its position, its zstd frame, and the data of its header and indexes."""

    start: int
    frame: Any
    first_ns: int
    last_ns: int = 0
    size: int = 0
    crc: int = 0
    packed: int = 0
    pending: list[bytes] = field(default_factory=list)
    indexes: dict[int, bytearray] = field(default_factory=dict)


class _Index:
    """Records for the end of the file, buffered in an unnamed temporary file because they grow by 20 MB per day.

    If other code closes the file descriptor, the data are lost and `taken` raises an error.
    """

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self._newest = bytearray()
        self._file: Descriptor | None = None

    def __del__(self) -> None:
        if self._file is not None:
            self._file.close()

    def add(self, record: bytes) -> None:
        self._newest += record
        if len(self._newest) > _KEPT:
            if self._file is None:
                with TemporaryFile(dir=self._folder) as file:
                    self._file = Descriptor(os.dup(file.fileno()))
            if self._file.is_open:
                _write_all(partial(os.write, self._file.number), self._newest)
            self._newest.clear()

    def taken(self) -> Iterator[bytes]:
        """Yield all buffered data in order."""
        if self._file is not None:
            if not self._file.is_open:
                raise OSError(errno.EBADF, "its index descriptor was closed; armlab log recover rebuilds the index")
            os.lseek(self._file.number, 0, os.SEEK_SET)
            while part := os.read(self._file.number, _KEPT):
                yield part
        yield bytes(self._newest)


class McapWriter:
    """Writer of an MCAP file with zstd chunks, message indexes and a summary."""

    def __init__(self, file: _WritableFile, profile: str, library: str) -> None:
        import zstandard

        self._file, self._at = file, 0
        self._compressor = zstandard.ZstdCompressor(level=1)
        self._block = zstandard.COMPRESSOBJ_FLUSH_BLOCK
        self._chunk: _OpenChunk | None = None
        self._schemas: dict[tuple[str, str, bytes], tuple[int, bytes]] = {}  # id and record
        self._channels: list[bytes] = []
        self._counts: dict[int, int] = {}
        self._times: tuple[int, int] | None = None  # first and last time of all chunks
        name = getattr(file, "name", None)
        self._index, self._chunks = _Index(Path(name).parent if isinstance(name, str) else None), 0
        self._attachments: list[bytes] = []
        self._metadata: list[bytes] = []
        self._put(kinds.MAGIC + _record(kinds.HEADER, _text(profile), _text(library)))

    @property
    def size(self) -> int:
        """Number of bytes in the current chunk, and thus the offset of the next record."""
        return 0 if self._chunk is None else self._chunk.size

    def metadata(self, name: str, pairs: Mapping[str, str]) -> None:
        """Write a map of strings under a name."""
        self.close_chunk()
        record = _record(kinds.METADATA, _text(name), _map(pairs))
        self._metadata.append(_record(kinds.METADATA_INDEX, struct.pack("<QQ", self._at, len(record)), _text(name)))
        self._put(record)

    def attach(self, log_ns: int, name: str, media_type: str, data: bytes) -> None:
        """Write an attachment with its time [ns]."""
        self.close_chunk()
        about = struct.pack("<QQ", log_ns, log_ns)
        body = b"".join([about, _text(name), _text(media_type), struct.pack("<Q", len(data)), data])
        record = _record(kinds.ATTACHMENT, body, struct.pack("<I", zlib.crc32(body)))
        place = struct.pack("<QQ", self._at, len(record))
        index = _record(
            kinds.ATTACHMENT_INDEX, place, about, struct.pack("<Q", len(data)), _text(name), _text(media_type)
        )
        self._attachments.append(index)
        self._put(record)

    def schema(self, name: str, encoding: str, text: bytes) -> int:
        """Write a schema unless it has been written before, and return its id."""
        key = name, encoding, text
        if key not in self._schemas:
            self.close_chunk()
            number = len(self._schemas) + 1
            body = [struct.pack("<H", number), _text(name), _text(encoding), struct.pack("<I", len(text)), text]
            self._schemas[key] = number, _record(kinds.SCHEMA, *body)
            self._put(self._schemas[key][1])
        return self._schemas[key][0]

    def channel(self, topic: str, encoding: str, schema: int, metadata: Mapping[str, str]) -> int:
        self.close_chunk()
        number = len(self._channels) + 1
        self._channels.append(
            _record(kinds.CHANNEL, struct.pack("<HH", number, schema), _text(topic), _text(encoding), _map(metadata))
        )
        self._put(self._channels[-1])
        self._counts[number] = 0
        return number

    def message(self, channel: int, sequence: int, log_ns: int, publish_ns: int, data: bytes | bytearray) -> None:
        """Add a message with its times [ns] to the current chunk; `push` writes the message to the file."""
        length = _MESSAGE_PREFIX + len(data)
        record = _MESSAGE.pack(kinds.MESSAGE, length, channel, sequence, log_ns, publish_ns) + data
        self.records(record, {channel: _ENTRY.pack(log_ns, self.size)}, log_ns, log_ns)

    def records(self, data: bytes, entries: Mapping[int, bytes], first_ns: int, last_ns: int) -> None:
        """Add message records encoded by `kernels.RowEncoder`, with their first and last time [ns]."""
        chunk = self._chunk
        if chunk is None:
            chunk = self._chunk = _OpenChunk(self._at, self._compressor.compressobj(), first_ns)
            self._put(_OPENED)
        for channel, made in entries.items():
            chunk.indexes.setdefault(channel, bytearray()).extend(made)
        chunk.pending.append(data)
        chunk.size += len(data)
        chunk.first_ns, chunk.last_ns = min(chunk.first_ns, first_ns), max(chunk.last_ns, last_ns)

    def push(self) -> None:
        """Pass all messages to the kernel, where they survive a crash of this process but not of the computer."""
        if self._chunk is not None and self._chunk.pending:
            self._push(self._chunk, self._block)

    def close_chunk(self) -> None:
        """Finish the current chunk, if any: write its last bytes, its final header and its indexes."""
        from zstandard import COMPRESSOBJ_FLUSH_FINISH

        chunk, self._chunk = self._chunk, None
        if chunk is None:
            return
        self._push(chunk, COMPRESSOBJ_FLUSH_FINISH)
        times = struct.pack("<QQ", chunk.first_ns, chunk.last_ns)
        length = _CHUNK_BODY + chunk.packed
        header = (chunk.first_ns, chunk.last_ns, chunk.size, chunk.crc, 4, b"zstd", chunk.packed)
        self._write_header(chunk.start, _CHUNK.pack(kinds.CHUNK, length, *header))
        places, indexes, at = [], [], self._at
        for channel, entries in chunk.indexes.items():
            places.append(struct.pack("<HQ", channel, at))
            indexes.append(_record(kinds.MESSAGE_INDEX, struct.pack("<HI", channel, len(entries)), bytes(entries)))
            at += len(indexes[-1])
            self._counts[channel] += len(entries) // _ENTRY.size
        where = struct.pack("<QQI", chunk.start, length + 9, sum(map(len, places)))
        sizes = struct.pack("<QI4sQQ", at - self._at, 4, b"zstd", chunk.packed, chunk.size)
        self._index.add(_record(kinds.CHUNK_INDEX, times, where, *places, sizes))
        self._chunks += 1
        first, last = self._times or (chunk.first_ns, chunk.last_ns)
        self._times = min(first, chunk.first_ns), max(last, chunk.last_ns)
        self._put(b"".join(indexes))

    def finish(self) -> None:
        """Write the current chunk, the summary and the footer."""
        self.close_chunk()
        self._put(_record(kinds.DATA_END, struct.pack("<I", 0)))
        schemas = [record for _, record in self._schemas.values()]
        before = [*schemas, *self._channels, self._statistics()]
        footer = struct.pack("<BQQQ", kinds.FOOTER, 20, self._at, 0)
        crc = 0
        for part in chain(before, self._index.taken(), self._attachments, self._metadata, [footer]):
            crc = zlib.crc32(part, crc)
            self._put(part)
        self._put(struct.pack("<I", crc) + kinds.MAGIC)

    def _push(self, chunk: _OpenChunk, how: int) -> None:
        data = b"".join(chunk.pending)
        chunk.pending.clear()
        chunk.crc = zlib.crc32(data, chunk.crc)
        packed = chunk.frame.compress(data) + chunk.frame.flush(how)
        chunk.packed += len(packed)
        self._put(packed)

    def _write_header(self, start: int, header: bytes) -> None:
        """Overwrite the open header of a chunk atomically: a partly written header would hide the messages."""
        try:
            self._file.seek(start)
            _write_all(self._file.write, header)
        except BaseException:
            with contextlib.suppress(OSError):
                self._file.seek(start)
                _write_all(self._file.write, _OPENED)
            raise
        self._file.seek(self._at)

    def _put(self, data: bytes) -> None:
        try:
            _write_all(self._file.write, data)
        except BaseException:  # readers would mistake a partial write for messages missing from the index
            with contextlib.suppress(OSError):
                self._file.truncate(self._at)
            raise
        self._at += len(data)

    def _statistics(self) -> bytes:
        first, last = self._times or (0, 0)
        counts = [struct.pack("<HQ", channel, count) for channel, count in self._counts.items() if count]
        numbers = (len(self._schemas), len(self._channels), len(self._attachments), len(self._metadata))
        head = struct.pack("<QHIIIIQQ", sum(self._counts.values()), *numbers, self._chunks, first, last)
        return _record(kinds.STATISTICS, head, struct.pack("<I", sum(map(len, counts))), *counts)


def _write_all(write: Callable[[Any], int], data: bytes | bytearray) -> None:
    """Write all data, because an unbuffered write may be partial."""
    done = write(data)
    while done < len(data):
        done += write(memoryview(data)[done:])


def _record(kind: int, *parts: bytes) -> bytes:
    return b"".join([struct.pack("<BQ", kind, sum(map(len, parts))), *parts])


def _text(text: str) -> bytes:
    raw = text.encode(errors="backslashreplace")  # file names in command lines may not be UTF-8
    return struct.pack("<I", len(raw)) + raw


def _map(pairs: Mapping[str, str]) -> bytes:
    raw = b"".join(_text(key) + _text(value) for key, value in pairs.items())
    return struct.pack("<I", len(raw)) + raw
