"""Chunks are checked before and after they are unpacked."""

from __future__ import annotations

import zlib
from dataclasses import replace

import lz4.frame
import pytest
import zstandard

from armlab.errors import LogError
from armlab.log.mcap.records import Chunk, end_of_blocks, most_unpacked, unpacked

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


def test_a_file_may_unpack_to_200_times_its_size() -> None:
    assert most_unpacked(100) == 1 << 24
    assert most_unpacked(1 << 20) == 200 << 20
    bomb = zstandard.ZstdCompressor().compress(bytes(1 << 25))
    with pytest.raises(LogError, match="at most 16777216 bytes at byte 7, got 33554432"):
        unpacked(memoryview(bomb), chunk(bomb, "zstd", size=1 << 25, crc=0))


def test_damage_and_unknown_compression() -> None:
    with pytest.raises(LogError, match="zstd data"):
        unpacked(memoryview(b"nonsense"), chunk(b"nonsense", "zstd"))
    with pytest.raises(LogError, match="lz4 data"):
        unpacked(memoryview(b"nonsense"), chunk(b"nonsense", "lz4"))
    with pytest.raises(LogError, match="'brotli'"):
        unpacked(memoryview(DATA), chunk(DATA, "brotli"))


def test_blocks_of_an_unfinished_frame() -> None:
    frame = zstandard.ZstdCompressor().compressobj()
    records = bytes([5]) + (200).to_bytes(8, "little") + bytes(range(200))
    first = frame.compress(records) + frame.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK)
    both = first + frame.compress(records) + frame.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK)
    view = memoryview(b"before" + both)
    assert end_of_blocks(view, 6) == len(view)
    assert end_of_blocks(view[:-1], 6) == 6 + len(first)
    assert end_of_blocks(view[:12], 6) == 6
    with pytest.raises(LogError, match="Expected zstd data at byte 0"):
        end_of_blocks(view, 0)
    for packed, count in ((both, 2), (first, 1), (both[:-1], 1), (first[:-1], 0)):
        one = replace(chunk(packed, "zstd"), is_open=True)
        assert unpacked(memoryview(packed), one) == records * count


def test_an_unfinished_frame_takes_no_memory_without_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("armlab.log.mcap.records._MAX_OPEN", 1 << 20)
    bomb = zstandard.ZstdCompressor().compress(b"\5" + (91).to_bytes(8, "little") + bytes(91) + b"\0" * 100_000_000)
    assert len(unpacked(memoryview(bomb), replace(chunk(bomb, "zstd"), is_open=True))) <= 2 << 20
