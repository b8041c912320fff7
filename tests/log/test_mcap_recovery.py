"""`recover`, and copying parts of MCAP files."""

from __future__ import annotations

import errno
import warnings
from collections.abc import Callable
from pathlib import Path

import pytest
from rosbags.highlevel import AnyReader

from armlab.errors import LogError
from armlab.log import inspect, read, recover
from armlab.log.mcap.records import contents
from armlab.log.mcap.recovery import Recovery, new_file


@pytest.fixture
def torn(recording: Callable[..., Path], tmp_path: Path) -> Path:
    data = recording(700, name="whole.mcap").read_bytes()
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
    assert held.metadata == original.metadata
    assert held.attachments == original.attachments
    assert held.events == original.events
    assert held.topics == original.topics
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
    empty = tmp_path / "empty.mcap"
    empty.write_bytes(torn.read_bytes()[:40])
    with pytest.raises(LogError, match="Expected messages in"):
        recover(empty)
    assert not list(tmp_path.glob("*.part"))


def test_the_original_is_safe_under_the_temporary_name(torn: Path, tmp_path: Path) -> None:
    original = torn.rename(tmp_path / "run.mcap.part")
    before = original.read_bytes()
    with pytest.raises(LogError, match=r"Expected to create .*run\.mcap\.part, got: File exists"):
        recover(original, tmp_path / "run.mcap")
    assert original.read_bytes() == before


def test_a_chunk_whose_header_is_damaged_is_counted(recording: Callable[..., Path]) -> None:
    path = recording(700)
    data = bytearray(path.read_bytes())
    chunk = contents(memoryview(bytes(data))).chunks[1]
    data[chunk.data[0] - 1] ^= 1  # its inner length
    path.write_bytes(data)
    with pytest.warns(UserWarning, match="record of kind 6 at byte"):
        rows = len(read(path))
    assert rows == 450
    assert recover(path).lost_chunks == 1


@pytest.mark.parametrize("links", [True, False])
def test_a_file_that_comes_while_it_works_is_not_overwritten(
    torn: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, links: bool
) -> None:
    def no_links(*_: object) -> None:
        raise OSError(errno.EPERM, "Operation not permitted")

    if not links:
        monkeypatch.setattr("os.link", no_links)
    other = tmp_path / "other.mcap"
    with pytest.raises(LogError, match="File exists"):
        recover(torn, other, progress=lambda *_: other.write_bytes(b"another's") and None)
    assert other.read_bytes() == b"another's"
    assert recover(torn).path.exists()
    assert not list(tmp_path.glob("*.part"))


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
