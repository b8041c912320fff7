"""The file of a recording: never over another, reopened, complete after kill -9."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from io import FileIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab.errors import ConfigError
from armlab.log import Log, Recorder, inspect, read, recover
from armlab.log.mcap.records import contents
from armlab.log.recording.file import MAX_CHUNK_ROWS, PersistentFile, RecordingFile, recording_path
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


@pytest.mark.parametrize("name", ["run.csv", "run.parquet", "run", "run.mcap.csv"])
def test_a_recording_has_no_name_of_another_format(name: str, tmp_path: Path, robot: Robot) -> None:
    assert recording_path("run.MCAP") == Path("run.MCAP")
    for written in (recording_path, Log(robot).save, lambda path: Recorder(path, robot)):
        with pytest.raises(ConfigError, match=rf"ending in \.mcap, got .*{name}\. Change the ending.*log\.write"):
            written(tmp_path / name)
    assert not list(tmp_path.iterdir())


def close_it(file: PersistentFile, folder: Path) -> int:
    os.close(file.fileno())
    return -1


def replace_it(file: PersistentFile, folder: Path) -> int:
    """Close it and open another file, which gets its number."""
    number = file.fileno()
    os.close(number)
    assert os.open(folder / "other", os.O_CREAT | os.O_WRONLY) == number
    return number


@pytest.mark.parametrize("lose", [close_it, replace_it])
def test_writing_goes_on_at_the_same_place(lose: Callable[[PersistentFile, Path], int], tmp_path: Path) -> None:
    file = PersistentFile(tmp_path / "run")
    file.write(b"0123456789")
    file.seek(2)
    number = lose(file, tmp_path)
    assert file.write(b"ab") == 2
    file.seek(4)
    file.truncate(8)
    os.fsync(file.fileno())
    assert (tmp_path / "run").read_bytes() == b"01ab4567"
    file.close()
    if number >= 0:
        os.close(number)
        assert (tmp_path / "other").read_bytes() == b""


def test_the_file_of_somebody_else_is_neither_written_nor_closed(tmp_path: Path) -> None:
    file = PersistentFile(tmp_path / "run")
    number = replace_it(file, tmp_path)
    file.close()
    os.write(number, b"theirs")
    os.close(number)
    with pytest.raises(OSError, match="Bad file descriptor"):
        file.write(b"x")
    assert (tmp_path / "run").read_bytes() == b""


def test_another_file_of_the_same_name_is_not_written(tmp_path: Path) -> None:
    file = PersistentFile(tmp_path / "run")
    close_it(file, tmp_path)
    (tmp_path / "run").rename(tmp_path / "moved")
    (tmp_path / "run").write_bytes(b"theirs")
    with pytest.raises(FileNotFoundError, match="another file has its name"):
        file.write(b"x")
    assert (tmp_path / "run").read_bytes() == b"theirs"
    with pytest.raises(FileExistsError):
        PersistentFile(tmp_path / "run")


MOST_ROWS = 25  # 0.1 s: written is every 0.04 s, and the thread that does it may wait for a core

CHILD = """
import sys, time
import numpy as np
from armlab import robots
from armlab.log import Recorder, Tick
from armlab.state import Command, State

robot, rng = robots.load("yumi_right"), np.random.default_rng(1)
recorder = Recorder(sys.argv[1], robot, attachments={"robot.toml": b"the description"}, note="kill test")
recorder.event("connected", time.time_ns())
period, start, wall = 0.004, time.monotonic(), time.time_ns()
i = 0
while True:
    q, qd, tau, sent = rng.normal(size=(4, 7))
    stamp = wall + i * 4_000_000
    state = State(i * period, period, q, qd, tau, seq=i, robot_ns=stamp, q_planned=q, wrench_raw=tau[:6])
    command = Command(q, qd, record={"wrench_hat": q[:6], "wrench_hat_cov": np.eye(6)})
    recorder.row(state, command, Tick(i, i, stamp, stamp, stamp + 1000, 500, q_sent=sent, clamped=np.zeros(7)))
    i += 1
    sys.stdout.write(f"{i}\\n")  # written after the row was queued: the parent's count never runs ahead
    sys.stdout.flush()
    time.sleep(max(0.0, start + i * period - time.monotonic()))
"""


def kill_one(path: Path, seconds: float) -> tuple[int, int]:
    """Record in real time at 250 Hz, kill after some seconds; return rows recorded and rows lost."""
    with subprocess.Popen([sys.executable, "-c", CHILD, str(path)], stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        count = int(child.stdout.readline())
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            count = int(child.stdout.readline())
        child.send_signal(signal.SIGKILL)
        lines = child.stdout.read().splitlines()  # what it wrote until it died
    whole = [int(line) for line in lines if line]
    count = max([count, *whole[:-1]])
    with pytest.warns(UserWarning, match="was not finished"):
        table = read(path)
    lost = max(count - len(table), 0)
    assert np.array_equal(table["seq"], np.arange(len(table)))
    held = inspect(path)
    assert not held.finished
    assert held.metadata["armlab"]["note"] == "kill test"
    assert held.attachments["robot.toml"] == b"the description"
    assert "connected" in [event.text for event in held.events]
    repaired = recover(path)
    assert read(repaired.path).sha256 == table.sha256
    return count, lost


@pytest.mark.parametrize(("number", "longest"), [(1, 2.0), pytest.param(6, 3.0, marks=pytest.mark.slow)])
def test_kill_9_loses_a_few_rows(tmp_path: Path, number: int, longest: float) -> None:
    rng, losses = np.random.default_rng(number), []
    for trial in range(number):
        count, lost = kill_one(tmp_path / f"run{trial}.mcap", rng.uniform(1.0, longest))
        assert count > 50
        losses.append(lost)
    assert max(losses) < MOST_ROWS
    assert np.median(losses) <= 12 or number < 6
