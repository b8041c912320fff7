"""Records and chunks of MCAP files, whole, torn and damaged."""

from __future__ import annotations

import warnings
import zlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard

from armlab.errors import LogError
from armlab.log import inspect, read, recover
from armlab.log.mcap import records as mcap_records
from armlab.log.mcap.records import (
    DAMAGE,
    MAGIC,
    OPEN,
    Attached,
    Channel,
    Chunk,
    Contents,
    contents,
    end_of_blocks,
    records,
    unpacked,
)


def test_summary_and_walk_agree(recording: Callable[..., Path]) -> None:
    view = memoryview(recording(300).read_bytes())
    quick, walked = contents(view), mcap_records._by_walking(view)
    assert isinstance(quick, Contents)
    assert quick.indexed
    assert not walked.indexed
    assert quick.finished
    assert walked.finished
    for name in ("profile", "library", "channels", "chunks", "attachments", "metadata"):
        assert getattr(quick, name) == getattr(walked, name), name
    assert isinstance(quick.channels[1], Channel)
    assert isinstance(quick.attachments[0], Attached)
    assert quick.profile == "ros2"


def test_a_damaged_summary_is_not_believed(recording: Callable[..., Path]) -> None:
    data = bytearray(recording(30).read_bytes())
    good = contents(memoryview(bytes(data)))
    place = data.rindex(b"/yumi_right/tick")  # in the summary: the channel again
    data[place + 1] ^= 1
    found = contents(memoryview(bytes(data)))
    assert not found.indexed
    assert found.channels == good.channels


def test_other_bytes_are_refused() -> None:
    with pytest.raises(LogError, match="Expected an MCAP file"):
        contents(memoryview(b"not MCAP"))
    with pytest.raises(LogError, match="Expected the header"):
        contents(memoryview(MAGIC + bytes([5]) + (0).to_bytes(8, "little")))
    assert LogError in DAMAGE


def test_a_header_of_damaged_length_leaves_the_summary(recording: Callable[..., Path]) -> None:
    data = bytearray(recording(30).read_bytes())
    good = contents(memoryview(bytes(data)))
    data[len(MAGIC) + 5] ^= 1
    found = contents(memoryview(bytes(data)))
    assert found.channels == good.channels
    assert found.chunks == good.chunks


@pytest.mark.parametrize("place", [-9, 28, 31])  # kind of the record; length of the name of the compression; that name
def test_no_chunk_is_left_out_without_a_word(recording: Callable[..., Path], place: int) -> None:
    data = bytearray(recording(700).read_bytes())
    chunks = contents(memoryview(bytes(data))).chunks
    whole, chunk = len(chunks), chunks[1]
    data[chunk.start + 9 + place] ^= 0x40
    found = mcap_records._by_walking(memoryview(bytes(data)))
    ((kind, sentence),) = found.damaged
    assert str(chunk.start) in sentence
    assert kind == (6 ^ 0x40 if place == -9 else 6)
    assert len(found.chunks) == whole - 1


def test_a_chunk_that_was_never_finished_is_taken_as_far_as_it_goes(recording: Callable[..., Path]) -> None:
    whole = recording(30).read_bytes()
    chunk = contents(memoryview(whole)).chunks[-1]
    begun = bytearray(whole[: chunk.stop])
    begun[chunk.start + 1 : chunk.start + 45] = OPEN.to_bytes(8, "little") + bytes(28) + b"\4\0\0\0zstd"
    begun[chunk.start + 45 : chunk.start + 53] = OPEN.to_bytes(8, "little")
    found = contents(memoryview(bytes(begun)))
    assert found.chunks[-1].is_open
    assert (found.torn, found.chunks[-1].stop) == (0, chunk.stop)
    cut = contents(memoryview(bytes(begun[:-5])))
    assert cut.chunks[-1].stop + cut.torn == len(begun) - 5
    begun[chunk.start + 41 : chunk.start + 45] = b"lz99"
    assert not any(one.is_open for one in contents(memoryview(bytes(begun))).chunks)


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


@pytest.fixture
def data(recording: Callable[..., Path], monkeypatch: pytest.MonkeyPatch) -> bytes:
    monkeypatch.setattr("armlab.log.recording.file.MAX_CHUNK_ROWS", 8)
    return recording(30, name="whole.mcap").read_bytes()


def check_sentence(error: LogError, path: Path) -> None:
    assert str(error).endswith(".")
    assert str(path) in str(error)


def attempt(path: Path, data: bytes, whole: dict[int, np.ndarray]) -> int | None:
    """Read, inspect and repair the bytes; return the number of rows, None when they were refused."""
    path.write_bytes(data)
    repaired = path.with_name("repaired.mcap")
    repaired.unlink(missing_ok=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for look in (inspect, lambda p: recover(p, repaired)):
            try:
                look(path)
            except LogError as error:
                check_sentence(error, path)
        try:
            table = read(path)
        except LogError as error:
            check_sentence(error, path)
            return None
    for seq, q in zip(table["seq"].tolist(), table["q"], strict=True) if len(table) else ():
        assert np.array_equal(whole[seq], q)  # what is read is what was written
    return len(table)


def reference(path: Path, data: bytes) -> dict[int, np.ndarray]:
    path.write_bytes(data)
    table = read(path)
    return dict(zip(table["seq"].tolist(), table["q"], strict=True))


def borders(data: bytes) -> Iterator[int]:
    for _, start, stop in records(memoryview(data), len(MAGIC), len(data)):
        yield from (start - 9, start, stop)


@pytest.mark.parametrize(("number", "every"), [(25, 15), pytest.param(1000, 1, marks=pytest.mark.slow)])
def test_cut_files(data: bytes, tmp_path: Path, number: int, every: int) -> None:
    whole = reference(tmp_path / "whole.mcap", data)
    places = sorted({place + d for place in borders(data) for d in (-1, 0, 1) if 0 <= place + d <= len(data)})[::every]
    places += np.random.default_rng(3).integers(0, len(data), number).tolist()
    found = {place: attempt(tmp_path / "cut.mcap", data[:place], whole) for place in places}
    rows = [found[place] or 0 for place in sorted(found)]
    assert rows == sorted(rows)  # more bytes never give fewer rows
    assert max(rows) >= 24


@pytest.mark.parametrize("number", [50, pytest.param(600, marks=pytest.mark.slow)])
def test_flipped_bytes(data: bytes, tmp_path: Path, number: int) -> None:
    whole = reference(tmp_path / "whole.mcap", data)
    rng = np.random.default_rng(4)
    rows = []
    for place, value in zip(rng.integers(0, len(data), number), rng.integers(1, 256, number), strict=True):
        damaged = bytearray(data)
        damaged[place] ^= value
        rows.append(attempt(tmp_path / "flip.mcap", bytes(damaged), whole))
    read_at_all = [count for count in rows if count]
    assert len(read_at_all) > 0.8 * number
    assert np.median(read_at_all) >= 22
