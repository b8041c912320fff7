"""Chunks of an MCAP file: compressed, checked, taken apart."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field

from armlab.errors import LogError

__all__ = ["Chunk", "unpacked"]

_MAX_CHUNK = 1 << 31  # bytes; a larger size is a damaged one


@dataclass(slots=True)
class Chunk:
    """A chunk of messages: where its record is [start, stop), its times, size and checksum, where its data are.

    `indexes` maps channels to the place [start, stop) of the entries of their MessageIndex.
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


def unpacked(view: memoryview, chunk: Chunk) -> bytes:
    """Return the records of a chunk.

    Raises
    ------
    LogError : the chunk is damaged (size, checksum) or compressed in an unknown way.
    """
    start, stop = chunk.data
    if chunk.size > _MAX_CHUNK:
        raise LogError(f"Expected a chunk of at most {_MAX_CHUNK} bytes at byte {chunk.start}, got {chunk.size}.")
    data = _decompressed(bytes(view[start:stop]), chunk)
    if len(data) != chunk.size:
        raise LogError(f"Expected {chunk.size} bytes in the chunk at byte {chunk.start}, got {len(data)}.")
    if chunk.crc and zlib.crc32(data) != chunk.crc:
        raise LogError(f"Expected checksum {chunk.crc:08x} of the chunk at byte {chunk.start}, got another.")
    return data


def _decompressed(packed: bytes, chunk: Chunk) -> bytes:
    if chunk.compression == "":
        return packed
    try:
        if chunk.compression == "zstd":
            import zstandard

            declared = zstandard.frame_content_size(packed)
            if declared not in (-1, chunk.size):  # before anything of that size is allocated
                raise LogError(f"Expected {chunk.size} bytes in the chunk at byte {chunk.start}, got {declared}.")
            return zstandard.ZstdDecompressor().decompress(packed, max_output_size=chunk.size)
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
