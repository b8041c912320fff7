"""Records, finished and torn, and what the summary and a walk agree on."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from armlab.errors import LogError
from armlab.log.mcap import records as mcap_records
from armlab.log.mcap.records import DAMAGE, MAGIC, OPEN, Attached, Channel, Contents, contents, records


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


def test_records_stop_at_the_first_that_is_cut() -> None:
    whole = bytes([5]) + (3).to_bytes(8, "little") + b"abc"
    view = memoryview(whole + whole[:-1])
    assert list(records(view, 0, len(view))) == [(5, 9, 12)]
    assert list(records(memoryview(b"\x05" + b"\xff" * 8), 0, 9)) == []


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
