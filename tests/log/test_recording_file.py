"""The file of a recording is whole after construction and after every sync."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from armlab.log import inspect, read
from armlab.log.recording_file import MAX_CHUNK_ROWS, RecordingFile, open_new
from armlab.log.rows import RowLayout
from armlab.robots import Robot


def test_everything_but_rows_is_on_the_disk_after_construction(tmp_path: Path, robot: Robot) -> None:
    file = RecordingFile(tmp_path / "run.mcap", robot, RowLayout(robot), {"a.toml": b"a"}, "mine")
    held = inspect(file.path)
    assert held.metadata["armlab"]["note"] == "mine"
    assert held.attachments == {"a.toml": b"a"}
    assert [event.text for event in held.events] == ["recording yumi_right"]
    assert len(held.topics) == 12 - 1
    file.finish({})


def test_rows_are_there_after_a_sync_and_no_chunk_is_longer_than_a_second(
    tmp_path: Path, robot: Robot, rows: Callable
) -> None:
    layout = RowLayout(robot)
    file = RecordingFile(tmp_path / "run.mcap", robot, layout, {}, "")
    for i in range(MAX_CHUNK_ROWS + 20):
        file.write(layout.pack(*rows(i)))
    file._file.flush()
    with pytest.warns(UserWarning, match=f"recovered {MAX_CHUNK_ROWS} rows"):
        read(file.path)
    file.sync()
    with pytest.warns(UserWarning, match=f"recovered {MAX_CHUNK_ROWS + 20} rows"):
        read(file.path)
    file.abandon()


def test_open_new(tmp_path: Path) -> None:
    for name in ("a.mcap", "a-2.mcap", "a-3.mcap"):
        file, path = open_new(tmp_path / "a.mcap")
        file.close()
        assert path.name == name
