"""The file is readable up to the last push at every length it ever has, and other readers open the finished one."""

from __future__ import annotations

import errno
import io
import os
import tracemalloc
from pathlib import Path

import pytest
from mcap.reader import make_reader

from armlab.log.mcap.decode import messages
from armlab.log.mcap.records import contents, unpacked
from armlab.log.mcap.writer import McapWriter


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
    writer.close_chunk()  # nothing in it: nothing is written
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
    assert summary.statistics is not None
    assert summary.statistics.message_count == 15
    assert summary.statistics.channel_message_counts == {a: 10, b: 5}
    assert summary.statistics.chunk_count == len(summary.chunk_indexes) == 2
    assert (summary.statistics.message_start_time, summary.statistics.message_end_time) == (91, 109)
    assert [(one.name, one.data) for one in reader.iter_attachments()] == [("a.bin", b"attached")]
    assert [one.metadata for one in reader.iter_metadata()] == [{"note": "ü"}]
    ours = contents(memoryview(file.getvalue()))
    assert ours.finished
    assert ours.indexed
    assert not ours.damaged
    assert ours.channels[a].metadata == {"k": "v"}


def test_memory_does_not_grow_with_the_chunks_of_a_day(tmp_path: Path) -> None:
    """Fails when the index of the chunks, which comes last, is kept in memory."""
    count, path = 2000, tmp_path / "long.mcap"
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
    """After five minutes the index is in a file without a name; nothing goes into the file that has its number then."""
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
        with pytest.raises(OSError, match="armlab log recover makes a new one"):
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
        numbers = [sequence for sequence, _, _ in messages(view, found, a)]
        assert numbers == list(range(max(count for size, count in pushed if size <= length)))
        assert 0 <= found.torn < length - closed + 1
        assert not found.damaged
    assert found.chunks[-1].is_open
    assert len(unpacked(view, found.chunks[-1])) == sum(31 + 50 * i for i in range(6, 12))


@pytest.mark.parametrize("noise", [b"\0" * 5000, b"\xff" * 5000, bytes(range(256)) * 20])
def test_what_follows_an_open_chunk_costs_nothing_before_it(noise: bytes) -> None:
    """After a loss of power the last blocks may be anything."""
    file = io.BytesIO()
    writer, a, _ = begun(file)
    for i in range(5):
        writer.message(a, i, i, i, b"x" * 90)
        writer.push()
    view = memoryview(file.getvalue() + noise)
    assert [sequence for sequence, _, _ in messages(view, contents(view), a)] == list(range(5))


def test_a_file_that_takes_less_than_given_gets_the_rest(tmp_path: Path) -> None:
    class Slow(io.BytesIO):
        def write(self, data) -> int:  # type: ignore[override]
            return super().write(bytes(data)[:7])

    files = Slow(), io.BytesIO()
    for file in files:
        writer, a, _ = begun(file)
        writer.message(a, 1, 2, 3, b"data")
        writer.finish()
    assert files[0].getvalue() == files[1].getvalue()


@pytest.mark.parametrize("taken", [0, 1, 9, 20, 57])
def test_a_header_of_which_the_disk_takes_a_part_hides_no_message(taken: int) -> None:
    """It is written over the open one in a file that is there already: that is what a failure must leave."""

    class Failing(io.BytesIO):
        failures = 1

        def write(self, data) -> int:  # type: ignore[override]
            if self.failures and self.tell() < len(self.getvalue()):
                self.failures -= 1
                super().write(bytes(data)[:taken])
                raise OSError(errno.EIO, "Input/output error")
            return super().write(data)

    file = Failing()
    writer, a, _ = begun(file)
    for i in range(5):
        writer.message(a, i, i, i, b"x" * 90)
        writer.push()
    with pytest.raises(OSError, match="Input/output error"):
        writer.close_chunk()
    view = memoryview(file.getvalue())
    found = contents(view)
    assert [sequence for sequence, _, _ in messages(view, found, a)] == list(range(5))
    assert found.chunks[-1].is_open
    assert not found.damaged
