"""MCAP files: records and chunks, whole, torn and damaged; the writer; recovery."""

from __future__ import annotations

import errno
import io
import os
import tracemalloc
import warnings
import zlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zstandard
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from armlab.errors import LogError
from armlab.log import Table, inspect, read, recover
from armlab.log.mcap.decode import messages
from armlab.log.mcap.records import MAGIC, Chunk, contents, most_unpacked, records, records_at, unpacked
from armlab.log.mcap.recovery import Recovery
from armlab.log.mcap.writer import McapWriter


def test_damage_of_the_summary_or_of_the_header(recording: Callable[..., Path]) -> None:
    whole = recording(30).read_bytes()
    good = contents(memoryview(whole))
    for place, is_believed in ((whole.rindex(b"/yumi_right/tick") + 1, False), (len(MAGIC) + 5, True)):
        data = bytearray(whole)
        data[place] ^= 1  # in the summary: the channel again; the length of the header
        found = contents(memoryview(data))
        assert found.indexed == is_believed
        assert (found.channels, len(found.chunks)) == (good.channels, len(good.chunks))
    data = bytearray(whole)
    data[good.chunks[0].data[0] + 30] ^= 1
    assert records_at(memoryview(data), contents(memoryview(data)), good.chunks[0]) is None


DATA = b"records " * 500


def chunk(packed: bytes, compression: str, size: int = len(DATA), crc: int = zlib.crc32(DATA)) -> Chunk:
    return Chunk(7, len(packed), 0, 1, size, crc, compression, (0, len(packed)))


def test_chunks_that_are_refused_before_memory_is_taken() -> None:
    assert (most_unpacked(100), most_unpacked(1 << 20)) == (1 << 24, 200 << 20)
    bomb, larger = (zstandard.ZstdCompressor().compress(bytes(size)) for size in (10_000_000, 1 << 25))
    for packed, compression, more, words in (
        (bomb, "zstd", {}, "got 10000000"),
        (bomb, "zstd", {"size": 1 << 60}, "at most"),
        (larger, "zstd", {"size": 1 << 25, "crc": 0}, "at most 16777216 bytes at byte 7, got 33554432"),
        (b"nonsense", "zstd", {}, "zstd data"),
        (b"nonsense", "lz4", {}, "lz4 data"),
        (DATA, "brotli", {}, "'brotli'"),
    ):
        with pytest.raises(LogError, match=words):
            unpacked(memoryview(packed), chunk(packed, compression, **more))


def test_an_unfinished_frame_takes_no_memory_without_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("armlab.log.mcap.records._MAX_OPEN", 1 << 20)
    bomb = zstandard.ZstdCompressor().compress(b"\5" + (91).to_bytes(8, "little") + bytes(91) + b"\0" * 100_000_000)
    assert len(unpacked(memoryview(bomb), replace(chunk(bomb, "zstd"), is_open=True))) <= 2 << 20


@pytest.fixture
def data(recording: Callable[..., Path], monkeypatch: pytest.MonkeyPatch) -> bytes:
    monkeypatch.setattr("armlab.log.recording.file.MAX_CHUNK_ROWS", 8)
    return recording(30, name="whole.mcap").read_bytes()


@pytest.fixture
def whole(data: bytes, tmp_path: Path) -> dict[int, np.ndarray]:
    """Positions by row number."""
    table = read(tmp_path / "whole.mcap")
    return dict(zip(table["seq"].tolist(), table["q"], strict=True))


def attempt(path: Path, data: bytes, whole: dict[int, np.ndarray]) -> int:
    """Read, inspect and repair the bytes, or refuse them with one error message; return the number of rows."""
    path.write_bytes(data)
    repaired = path.with_name("repaired.mcap")
    repaired.unlink(missing_ok=True)
    rows = 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for look in (inspect, lambda p: recover(p, repaired), read):
            try:
                found = look(path)
            except LogError as error:
                assert str(error).endswith(".")  # noqa: PT017
                assert str(path) in str(error)  # noqa: PT017
                continue
            if isinstance(found, Table):
                rows = len(found)
                for seq, q in zip(found["seq"].tolist(), found["q"], strict=True) if rows else ():
                    assert np.array_equal(whole[seq], q)  # what is read is what was written
    return rows


def borders(data: bytes) -> Iterator[int]:
    for _, start, stop in records(memoryview(data), len(MAGIC), len(data)):
        yield from (start - 9, start, stop)


@pytest.mark.parametrize(("number", "every"), [(20, 23), pytest.param(600, 2, marks=pytest.mark.slow)])
def test_cut_files(data: bytes, whole: dict, tmp_path: Path, number: int, every: int) -> None:
    places = sorted({place + d for place in borders(data) for d in (-1, 0, 1) if 0 <= place + d <= len(data)})[::every]
    places += np.random.default_rng(3).integers(0, len(data), number).tolist()
    found = {place: attempt(tmp_path / "cut.mcap", data[:place], whole) for place in places}
    rows = [found[place] for place in sorted(found)]
    assert rows == sorted(rows)  # more bytes never give fewer rows
    assert max(rows) >= 24


@pytest.mark.parametrize("number", [40, pytest.param(700, marks=pytest.mark.slow)])
def test_flipped_bytes(data: bytes, whole: dict, tmp_path: Path, number: int) -> None:
    rng = np.random.default_rng(4)
    rows = []
    for place, value in zip(rng.integers(0, len(data), number), rng.integers(1, 256, number), strict=True):
        damaged = bytearray(data)
        damaged[place] ^= value
        rows.append(attempt(tmp_path / "flip.mcap", bytes(damaged), whole))
    read_at_all = [count for count in rows if count]
    assert len(read_at_all) > 0.8 * number
    assert np.median(read_at_all) >= 22


def test_noise_after_the_magic_bytes(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    for _ in range(20):
        noise = MAGIC + rng.integers(0, 256, int(rng.integers(0, 400)), dtype=np.uint8).tobytes()
        assert attempt(tmp_path / "noise.mcap", noise, {}) == 0


def numbers(data: bytes, channel: int) -> list[int]:
    """Return the sequence numbers of the readable messages."""
    view = memoryview(data)
    return [sequence for sequence, _, _ in messages(view, contents(view), channel)]


def begun(file: io.BufferedIOBase) -> tuple[McapWriter, int, int]:
    writer = McapWriter(file, "ros2", "test")  # type: ignore[arg-type]
    writer.metadata("about", {"note": "ü"})
    writer.attach(5, "a.bin", "application/octet-stream", b"attached")
    schema = writer.schema("pkg/msg/T", "ros2msg", b"int64 a")
    return writer, writer.channel("/a", "cdr", schema, {"k": "v"}), writer.channel("/b", "cdr", schema, {})


def test_other_readers_find_everything() -> None:
    file = io.BytesIO()
    writer, a, b = begun(file)
    for i in range(10):
        writer.message(a, i, 100 - i, 200 + i, b"\0" * i)
        if i % 2:
            writer.message(b, i, 100 + i, 200 + i, bytearray(b"b"))
        if i % 3 == 0:
            writer.push()
        if i == 6:
            writer.close_chunk()
    writer.close_chunk()
    writer.close_chunk()  # empty: nothing is written
    writer.finish()
    for validated in (False, True):
        reader = make_reader(io.BytesIO(file.getvalue()), validate_crcs=validated)
        found = list(reader.iter_messages(log_time_order=False))
        assert [(c.topic, m.sequence) for _, c, m in found if c.topic == "/a"] == [("/a", i) for i in range(10)]
        assert [m.data for _, c, m in found if c.topic == "/b"] == [b"b"] * 5
        assert found[3][2].publish_time == 200 + found[3][2].sequence
    assert [m.log_time for _, _, m in reader.iter_messages(topics="/a")] == list(range(91, 101))  # by the indexes
    summary = reader.get_summary()
    assert summary is not None
    statistics = summary.statistics
    assert statistics is not None
    assert (statistics.message_count, statistics.channel_message_counts) == (15, {a: 10, b: 5})
    assert statistics.chunk_count == len(summary.chunk_indexes) == 2
    assert (statistics.message_start_time, statistics.message_end_time) == (91, 109)
    assert [(one.name, one.data) for one in reader.iter_attachments()] == [("a.bin", b"attached")]
    assert [one.metadata for one in reader.iter_metadata()] == [{"note": "ü"}]
    ours = contents(memoryview(file.getvalue()))
    assert (ours.finished, ours.indexed, ours.damaged, ours.channels[a].metadata) == (True, True, [], {"k": "v"})


def test_memory_does_not_grow_with_the_chunks_of_a_day(tmp_path: Path) -> None:
    count, path = 1600, tmp_path / "long.mcap"
    with path.open("xb", buffering=0) as file:
        writer, a, b = begun(file)
        tracemalloc.start()
        try:
            for i in range(count):
                writer.message(a, i, count - i, i, b"")
                writer.message(b, i, i, i, b"")
                writer.close_chunk()
                if i == count // 2:
                    before, _ = tracemalloc.get_traced_memory()
            grown = tracemalloc.get_traced_memory()[0] - before
        finally:
            tracemalloc.stop()
        assert grown < 2**17, "bytes; in memory it would be 2**18"
        writer.finish()
    assert [one.name for one in tmp_path.iterdir()] == ["long.mcap"]
    with path.open("rb") as file:
        summary = make_reader(file, validate_crcs=True).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert len(summary.chunk_indexes) == summary.statistics.chunk_count == count
    assert [len(one.message_index_offsets) for one in summary.chunk_indexes] == [2] * count
    assert (summary.statistics.message_start_time, summary.statistics.message_end_time) == (0, count)


def test_an_index_whose_descriptor_was_closed_costs_the_summary_and_no_message(tmp_path: Path) -> None:
    """After five minutes, the index is in an unnamed file; a file that reuses its descriptor is not written to."""
    count, path, other = 3000, tmp_path / "long.mcap", tmp_path / "other"
    with path.open("xb", buffering=0) as file:
        writer, a, _ = begun(file)
        for i in range(count):
            if i == count // 2:
                assert writer._index._file is not None
                number = writer._index._file.number
                with other.open("wb") as theirs:
                    os.dup2(theirs.fileno(), number)
            writer.message(a, i, i, i, b"")
            writer.close_chunk()
        with pytest.raises(OSError, match="armlab log recover rebuilds the index"):
            writer.finish()
    os.close(number)
    assert other.read_bytes() == b""
    found = contents(memoryview(path.read_bytes()))
    assert len(found.chunks) == count
    assert not found.finished


def test_cut_at_every_byte_the_messages_pushed_before_are_there() -> None:
    file = io.BytesIO()
    writer, a, _ = begun(file)
    pushed = []
    for i in range(12):
        writer.message(a, i, i, i, bytes([i]) * 50 * i)
        if i == 5:
            writer.close_chunk()
        writer.push()
        pushed.append((len(file.getvalue()), i + 1))
    data = file.getvalue()
    closed = pushed[5][0]
    for length in range(closed, len(data) + 1):
        view = memoryview(data[:length])
        found = contents(view)
        assert numbers(data[:length], a) == list(range(max(count for size, count in pushed if size <= length)))
        assert 0 <= found.torn < length - closed + 1
        assert not found.damaged
    assert found.chunks[-1].is_open
    assert len(unpacked(view, found.chunks[-1])) == sum(31 + 50 * i for i in range(6, 12))


@pytest.mark.parametrize("noise", [b"\0" * 5000, b"\xff" * 5000, bytes(range(256)) * 20])
def test_what_follows_an_open_chunk_costs_nothing_before_it(noise: bytes) -> None:
    file = io.BytesIO()
    writer, a, _ = begun(file)
    for i in range(5):
        writer.message(a, i, i, i, b"x" * 90)
        writer.push()
    assert numbers(file.getvalue() + noise, a) == list(range(5))


@pytest.mark.parametrize("taken", [0, 9, 57])
def test_a_header_of_which_the_disk_takes_a_part_hides_no_message(taken: int) -> None:
    """The header overwrites that of the open chunk in the file; a failed write must leave the chunk open."""

    class Failing(io.BytesIO):
        failures = 1

        def write(self, data) -> int:  # type: ignore[override]
            if self.failures and self.tell() < len(self.getvalue()):
                self.failures -= 1
                super().write(bytes(data)[:taken])
                raise OSError(errno.EIO, "Input/output error")
            return super().write(bytes(data)[:40])  # after a short write, the rest is written

    file = Failing()
    writer, a, _ = begun(file)
    for i in range(5):
        writer.message(a, i, i, i, b"x" * 90)
        writer.push()
    with pytest.raises(OSError, match="Input/output error"):
        writer.close_chunk()
    found = contents(memoryview(file.getvalue()))
    assert (found.chunks[-1].is_open, found.damaged, numbers(file.getvalue(), a)) == (True, [], list(range(5)))


@pytest.fixture
def torn(recording: Callable[..., Path], tmp_path: Path) -> Path:
    data = recording(400, name="whole.mcap").read_bytes()
    path = tmp_path / "torn.mcap"
    path.write_bytes(data[: int(0.8 * len(data))])
    return path


def test_the_copy_is_whole_and_holds_the_same(torn: Path) -> None:
    before = torn.read_bytes()
    told: list[tuple[int, int, str]] = []
    done = recover(torn, progress=lambda *step: told.append(step))
    assert isinstance(done, Recovery)
    assert done.path.name == "torn.recovered.mcap"
    with pytest.warns(UserWarning, match="not finished"):
        table = read(torn)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert read(done.path).sha256 == table.sha256
    assert torn.read_bytes() == before
    held, original = inspect(done.path), inspect(torn)
    assert held.finished
    for name in ("metadata", "attachments", "events", "topics"):
        assert getattr(held, name) == getattr(original, name), name
    assert done.torn == original.torn > 0
    assert done.messages == sum(topic.messages for topic in held.topics)
    assert done.seconds == pytest.approx(table.t[-1], abs=1e-6)  # the events are on another clock here
    assert told[-1][0] <= told[-1][1] == len(before)
    with AnyReader([done.path]) as reader:
        assert sum(1 for _ in reader.messages()) == done.messages
    assert sorted(path.name for path in torn.parent.iterdir()) == ["torn.mcap", "torn.recovered.mcap", "whole.mcap"]


def test_nothing_is_overwritten_and_nothing_half_is_left(torn: Path, tmp_path: Path) -> None:
    done = recover(torn)
    with pytest.raises(LogError, match="Expected no file at"):
        recover(torn)
    assert recover(torn, tmp_path / "other.mcap").messages == done.messages
    with pytest.raises(LogError, match="Expected to create"):
        recover(torn, tmp_path / "nowhere" / "other.mcap")
    original = torn.rename(tmp_path / "run.mcap.part")  # safe under the temporary name, too
    before = original.read_bytes()
    with pytest.raises(LogError, match=r"Expected to create .*run\.mcap\.part, got: File exists"):
        recover(original, tmp_path / "run.mcap")
    assert original.read_bytes() == before
    torn = original.rename(torn)
    empty, late = tmp_path / "empty.mcap", tmp_path / "late.mcap"
    empty.write_bytes(torn.read_bytes()[:40])
    with pytest.raises(LogError, match="Expected messages in"):
        recover(empty)
    with pytest.raises(LogError, match="File exists"):  # a file created meanwhile
        recover(torn, late, progress=lambda *_: late.write_bytes(b"another's") and None)
    assert late.read_bytes() == b"another's"
    assert not list(tmp_path.glob("*.part"))


# Inner length; kind of the record; first and last byte of the length of the compression's name.
@pytest.mark.parametrize("place", [48, 0, 37, 40])
def test_no_chunk_is_left_out_without_a_word(recording: Callable[..., Path], place: int) -> None:
    path = recording(700)
    data = bytearray(path.read_bytes())
    chunk = contents(memoryview(bytes(data))).chunks[1]
    data[chunk.start + place] ^= 0x40
    data[-100] ^= 1  # in the summary, which would show the chunk
    path.write_bytes(data)
    with pytest.warns(UserWarning, match=rf"record of kind {70 if place == 0 else 6} at byte {chunk.start} skipped"):
        rows = len(read(path))
    start, stop = chunk.indexes[2]  # of the ticks
    assert rows == 700 - (stop - start) // 16
    assert recover(path).lost_chunks == (place != 0)
