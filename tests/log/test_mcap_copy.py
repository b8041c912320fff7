"""What copies of recordings are made of."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from armlab.errors import LogError
from armlab.log.mcap.records import contents
from armlab.log.mcap.recovery import Registry, messages_in, new_file, pieces, records_at
from armlab.log.mcap.writer import McapWriter


def test_a_copy_made_of_its_parts_holds_the_same(recording: Callable[..., Path], tmp_path: Path) -> None:
    view = memoryview(recording(300).read_bytes())
    found = contents(view)
    held = []
    with new_file(tmp_path / "copy.mcap", tmp_path / "part", replace=False) as file:
        writer = McapWriter(file, found.profile, found.library)
        registry = Registry(writer)
        numbers = {number: registry.channel(channel) for number, channel in found.channels.items()}
        for piece in pieces(found):
            data = records_at(view, found, piece)
            assert data is not None
            held += list(messages_in(data))
        for channel, *rest in held:
            writer.message(numbers[channel], *rest)
        writer.finish()
    copied = contents(copy := memoryview((tmp_path / "copy.mcap").read_bytes()))
    assert copied.channels == found.channels
    again = [one for piece in pieces(copied) for one in messages_in(records_at(copy, copied, piece) or b"")]
    assert again == held
    assert len(copied._schemas) == len({channel.type for channel in found.channels.values()})


def test_a_damaged_chunk_has_no_records(recording: Callable[..., Path]) -> None:
    data = bytearray(recording(300).read_bytes())
    chunk = contents(memoryview(bytes(data))).chunks[0]
    data[chunk.data[0] + 30] ^= 1
    assert records_at(memoryview(data), contents(memoryview(data)), chunk) is None


def test_a_new_file_is_whole_or_not_there(tmp_path: Path) -> None:
    target, part = tmp_path / "target", tmp_path / "part"
    with pytest.raises(KeyboardInterrupt), new_file(target, part, replace=True):
        raise KeyboardInterrupt
    assert not list(tmp_path.iterdir())
    with new_file(target, part, replace=True) as file:
        file.write(b"1")
    with new_file(target, part, replace=True) as file:
        file.write(b"2")
    with (
        pytest.raises(LogError, match=r"Expected to write .*target, got: File exists"),
        new_file(target, part, replace=False),
    ):
        pass
    assert target.read_bytes() == b"2"
    assert [entry.name for entry in tmp_path.iterdir()] == ["target"]
