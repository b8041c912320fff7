"""The file of a recording is whole after construction and after every row."""

from __future__ import annotations

import errno
from collections.abc import Callable
from io import FileIO
from pathlib import Path
from typing import Any

import pytest

from armlab.errors import ConfigError
from armlab.log import Log, Recorder, inspect, read
from armlab.log.mcap.records import contents
from armlab.log.recording.file import MAX_CHUNK_ROWS, RecordingFile, open_new, recording_path
from armlab.log.recording.rows import RowLayout
from armlab.robots import Robot, from_toml


def test_everything_but_rows_is_on_the_disk_after_construction(tmp_path: Path, robot: Robot) -> None:
    file = RecordingFile(tmp_path / "run.mcap", robot, RowLayout(robot), {"a.toml": b"a"}, "mine")
    held = inspect(file.path)
    assert held.metadata["armlab"]["note"] == "mine"
    assert held.attachments["a.toml"] == b"a"
    assert from_toml(held.attachments["robot.toml"].decode(), "it").hash == robot.hash
    assert not held.events
    assert len(held.topics) == 18
    file.event("first", 5)
    file.finish({})
    assert [(event.stamp_ns, event.text) for event in inspect(file.path).events] == [
        (5, "recording yumi_right"),
        (5, "first"),
    ]


def test_each_row_is_there_at_once_and_no_chunk_is_longer_than_a_second(
    tmp_path: Path, robot: Robot, rows: Callable
) -> None:
    layout = RowLayout(robot)
    file = RecordingFile(tmp_path / "run.mcap", robot, layout, {}, "")
    for i in range(MAX_CHUNK_ROWS + 20):
        file.write([layout.pack(*rows(i))])
        if i in (0, MAX_CHUNK_ROWS - 2, MAX_CHUNK_ROWS - 1, MAX_CHUNK_ROWS + 19):
            with pytest.warns(UserWarning, match=rf"recovered {i + 1} rows \(.*, 0 bytes torn"):
                read(file.path)
    file.event("the last word", 1)
    file.abandon()
    assert inspect(file.path).events[-1].text == "the last word"
    assert [chunk.is_open for chunk in contents(memoryview(file.path.read_bytes())).chunks] == [False, True]


def test_of_a_write_that_failed_half_way_nothing_is_left(tmp_path: Path, robot: Robot, rows: Callable) -> None:
    """Else rows would be read that were not counted, and one of them torn."""
    layout = RowLayout(robot)
    file = RecordingFile(tmp_path / "run.mcap", robot, layout, {}, "")
    file.write([layout.pack(*rows(i)) for i in range(10)])

    class Full(FileIO):
        def write(self, data: Any) -> int:
            super().write(data[: len(data) * 3 // 4])
            raise OSError(errno.ENOSPC, "No space left on device")

    size = file.path.stat().st_size
    file._writer._file = Full(file._file.fileno(), "r+", closefd=False)
    with pytest.raises(OSError, match="No space left"):
        file.write([layout.pack(*rows(i)) for i in range(10, 210)])
    file.abandon()
    assert file.path.stat().st_size == size
    with pytest.warns(UserWarning, match="not finished"):
        assert len(read(file.path)) == file.rows == 10


def test_open_new(tmp_path: Path) -> None:
    for name in ("a.mcap", "a-2.mcap", "a-3.mcap"):
        file, path = open_new(tmp_path / "a.mcap")
        file.close()
        assert path.name == name


@pytest.mark.parametrize("name", ["run.csv", "run.parquet", "run", "run.mcap.csv"])
def test_a_recording_has_no_name_of_another_format(name: str, tmp_path: Path, robot: Robot) -> None:
    assert recording_path("run.MCAP") == Path("run.MCAP")
    for written in (recording_path, Log(robot).save, lambda path: Recorder(path, robot)):
        with pytest.raises(ConfigError, match=rf"ending in \.mcap, got .*{name}\. Change the ending.*log\.write"):
            written(tmp_path / name)
    assert not list(tmp_path.iterdir())
