"""Chunks of an MCAP file: compressed, checked, taken apart."""

from __future__ import annotations

import threading
import zlib
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from armlab.errors import LogError

if TYPE_CHECKING:
    import zstandard

__all__ = ["Chunk", "end_of_blocks", "most_unpacked", "unpacked"]

_MAX_CHUNK = 1 << 31  # bytes; a larger size is a damaged one
_MAX_OPEN = 1 << 28  # bytes; of a chunk that does not tell its size
_UNPACKED, _RATIO = 1 << 24, 200  # bytes of any file; above that, for each of its own: zstd reaches 15 000
_PIECE = 1 << 20
_REPEATED, _RESERVED = 1, 3  # kinds of zstd blocks
_of_thread = threading.local()


@dataclass(slots=True)
class Chunk:
    """A chunk of messages: where its record is [start, stop), its times, size and checksum, where its data are.

    `indexes` maps channels to the place [start, stop) of the entries of their MessageIndex. `is_open`: its writer died
    before it wrote times, size and checksum.
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
    """Return the bytes that all chunks of a file may unpack to.

    Parameters
    ----------
    size : bytes of the file.
    """
    return max(_UNPACKED, _RATIO * size)


def end_of_blocks(view: memoryview, at: int) -> int:
    """Return where the last whole block of the zstd frame at this place ends; `at` when there is none.

    Raises
    ------
    LogError : no such frame begins there.
    """
    import zstandard

    header = bytes(view[at : at + 18])
    try:
        zstandard.get_frame_parameters(header)  # the size alone does not look at the magic number
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
    """Return the records of a chunk.

    Raises
    ------
    LogError : the chunk is damaged (size, checksum) or compressed in an unknown way.
    """
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
        raise LogError(f"Expected checksum {chunk.crc:08x} of the chunk at byte {chunk.start}, got another.")
    return data


def _unpacked_open(packed: bytes, most: int) -> bytes:
    """Return the whole records in the blocks of an unfinished zstd frame, of about so many bytes."""
    import zstandard

    pieces, size = [], 0
    try:
        with zstandard.ZstdDecompressor().stream_reader(packed) as reader:
            while size < most and (piece := reader.read(_PIECE)):
                pieces.append(piece)
                size += len(piece)
    except zstandard.ZstdError:  # what was read before stays
        pass
    data = b"".join(pieces)
    end = 0
    while end + 9 <= len(data):
        length = int.from_bytes(data[end + 1 : end + 9], "little")
        if length > len(data) - end - 9:
            break
        end += 9 + length
    return data[:end]


def _decompressor() -> zstandard.ZstdDecompressor:
    """Return the decompressor of this thread: its tables are as large as a chunk."""
    import zstandard

    if not hasattr(_of_thread, "decompressor"):
        _of_thread.decompressor = zstandard.ZstdDecompressor()
    return _of_thread.decompressor


def _decompressed(packed: memoryview, chunk: Chunk) -> bytes:
    if chunk.compression == "":
        return bytes(packed)
    try:
        if chunk.compression == "zstd":
            import zstandard

            declared = zstandard.frame_content_size(packed)
            if declared not in (-1, chunk.size):  # before anything of that size is allocated
                raise LogError(f"Expected {chunk.size} bytes in the chunk at byte {chunk.start}, got {declared}.")
            return _decompressor().decompress(packed, max_output_size=chunk.size)
        if chunk.compression == "lz4":
            import lz4.frame

            return lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=chunk.size + 1)
    except LogError:
        raise
    except ImportError:
        raise LogError("Expected the package lz4 for this file; install it with `pip install lz4`.") from None
    except Exception as error:  # the codecs' own errors share no base class
        raise LogError(f"Expected {chunk.compression} data in the chunk at byte {chunk.start}, got: {error}.") from None
    raise LogError(f"Expected compression zstd, lz4 or none, got {chunk.compression!r} at byte {chunk.start}.")
