"""Chunks are checked before and after they are unpacked."""

from __future__ import annotations

import zlib

import lz4.frame
import pytest
import zstandard

from armlab.errors import LogError
from armlab.log.mcap_chunk import Chunk, unpacked

DATA = b"records " * 500


def chunk(packed: bytes, compression: str, size: int = len(DATA), crc: int = zlib.crc32(DATA)) -> Chunk:
    return Chunk(7, len(packed), 0, 1, size, crc, compression, (0, len(packed)))


@pytest.mark.parametrize(
    ("compression", "pack"), [("", bytes), ("zstd", zstandard.compress), ("lz4", lz4.frame.compress)]
)
def test_every_compression(compression: str, pack) -> None:
    packed = pack(DATA)
    assert unpacked(memoryview(packed), chunk(packed, compression)) == DATA
    assert unpacked(memoryview(packed), chunk(packed, compression, crc=0)) == DATA
    with pytest.raises(LogError, match="checksum"):
        unpacked(memoryview(packed), chunk(packed, compression, crc=1))
    with pytest.raises(LogError, match="bytes in the chunk at byte 7"):
        unpacked(memoryview(packed), chunk(packed, compression, size=len(DATA) + 1))


def test_sizes_are_checked_before_memory_is_taken() -> None:
    bomb = zstandard.ZstdCompressor().compress(b"\0" * 10_000_000)
    with pytest.raises(LogError, match="got 10000000"):
        unpacked(memoryview(bomb), chunk(bomb, "zstd"))
    with pytest.raises(LogError, match="at most"):
        unpacked(memoryview(bomb), chunk(bomb, "zstd", size=1 << 60))


def test_damage_and_unknown_compression() -> None:
    with pytest.raises(LogError, match="zstd data"):
        unpacked(memoryview(b"nonsense"), chunk(b"nonsense", "zstd"))
    with pytest.raises(LogError, match="lz4 data"):
        unpacked(memoryview(b"nonsense"), chunk(b"nonsense", "lz4"))
    with pytest.raises(LogError, match="'brotli'"):
        unpacked(memoryview(DATA), chunk(DATA, "brotli"))
