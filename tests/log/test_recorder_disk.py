"""A recorder on a disk that stands still, is full, is slow to sync or fails."""

from __future__ import annotations

import errno
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from armlab.log import Recorder, inspect, read
from armlab.log.recording import file as recording_file
from armlab.log.recording.recorder import QUEUE_ROWS
from armlab.robots import Robot

PATIENCE = 20.0  # s: only a test that fails waits so long


class Stalled:
    """A file whose disk stands still until it is released; `fails` makes it full in the next write, by half."""

    def __init__(self, file) -> None:
        self.file, self.gate, self.fails = file, threading.Event(), False
        self.gate.set()
        self.reached = threading.Event()

    def write(self, data) -> int:
        if not self.gate.is_set():
            self.reached.set()
        self.gate.wait(PATIENCE)
        if self.fails:
            self.file.write(data[: len(data) // 2])
            raise OSError(errno.ENOSPC, "No space left on device")
        return self.file.write(data)

    def __getattr__(self, name: str):
        return getattr(self.file, name)


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Callable[[], Stalled]:
    made: list[Stalled] = []
    real = recording_file.open_new

    def opened(path: Path):
        file, path = real(path)
        made.append(Stalled(file))
        return made[-1], path

    monkeypatch.setattr(recording_file, "open_new", opened)
    return lambda: made[-1]


def test_a_stalled_disk_drops_rows_counts_them_exactly_and_keeps_the_rest(
    tmp_path: Path, robot: Robot, rows: Callable, disk: Callable[[], Stalled]
) -> None:
    sample = [rows(i) for i in range(50)]
    recorder = Recorder(tmp_path / "run.mcap", robot)
    stalled = disk()
    stalled.gate.clear()

    def put(i: int) -> bool:
        state, command, tick = sample[i % 50]
        return recorder.row(state, command, tick._replace(number=i))

    i = 0
    while not stalled.reached.is_set():  # until the writer hangs in the disk
        assert put(i)
        i += 1
        stalled.reached.wait(0.002)
    accepted = [put(i) for i in range(i, i + QUEUE_ROWS + 300)]
    dropped = accepted.count(False)
    assert dropped > 0
    assert accepted.index(False) == len(accepted) - dropped
    assert recorder.dropped == dropped
    stalled.gate.set()
    last = i + len(accepted)
    while not put(last):  # the first row that finds room ends the hole
        dropped += 1
        last += 1
    recorder.close()
    table = read(recorder.path, raw=True)
    first = i + accepted.index(False)
    assert recorder.dropped == dropped
    assert np.array_equal(table["tick"], [*range(first), last])
    assert inspect(recorder.path).summary["holes"] == [[first, last - 1, dropped]]
    told = [event.text for event in inspect(recorder.path).events]
    assert any(f"{dropped} rows were dropped, ticks {first} to {last - 1}" in text for text in told)
    assert len(table) == recorder.rows
    assert table.notes[0] == f"{dropped} rows were dropped while recording: ticks {first} to {last - 1}"


def test_a_full_disk_stops_the_recorder_not_the_loop(
    tmp_path: Path, robot: Robot, rows: Callable, disk: Callable[[], Stalled]
) -> None:
    recorder = Recorder(tmp_path / "run.mcap", robot)
    for i in range(recording_file.MAX_CHUNK_ROWS):
        assert recorder.row(*rows(i))
    disk().fails = True
    i = recording_file.MAX_CHUNK_ROWS
    while recorder.failed is None:
        recorder.row(*rows(i % 300))
        i += 1
    assert not recorder.row(*rows(0))
    assert "No space left on device" in recorder.failed
    assert recorder.failed.endswith(".")
    recorder.close()
    assert recorder.rows + recorder.dropped == i + 1
    with pytest.warns(UserWarning, match="not finished"):
        assert len(read(recorder.path, raw=True)) == recorder.rows


def test_a_disk_that_is_slow_to_sync_holds_up_no_row(
    tmp_path: Path, robot: Robot, rows: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else a process that is killed meanwhile would lose what had come since."""
    gate, reached = threading.Event(), threading.Event()
    monkeypatch.setattr("armlab.log.recording.recorder.FLUSH_PERIOD", 0.0)
    recorder = Recorder(tmp_path / "run.mcap", robot)
    monkeypatch.setattr("armlab.log.recording.file.os.fsync", lambda _: (reached.set(), gate.wait(PATIENCE)))
    recorder.row(*rows(0))
    assert reached.wait(PATIENCE)
    for i in range(1, 5):
        recorder.row(*rows(i))
    until = time.monotonic() + PATIENCE
    while recorder._file.rows < 5 or recorder._file._chunk_rows:  # a chunk that is being closed is no file to read
        assert time.monotonic() < until
        time.sleep(0.001)
    with pytest.warns(UserWarning, match="not finished"):
        assert len(read(recorder.path)) == 5
    gate.set()
    recorder.close()
    assert inspect(recorder.path).finished


def test_a_sync_that_fails_stops_the_recorder(
    tmp_path: Path, robot: Robot, rows: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(_: int) -> None:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr("armlab.log.recording.recorder.FLUSH_PERIOD", 0.0)
    recorder = Recorder(tmp_path / "run.mcap", robot)
    monkeypatch.setattr("armlab.log.recording.file.os.fsync", broken)
    while recorder.failed is None:
        recorder.row(*rows(0))
    assert recorder.failed.endswith("Input/output error.")
    recorder.close()


def test_an_error_whose_text_cannot_be_made_stops_the_recorder(
    tmp_path: Path, robot: Robot, rows: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    """There may be no memory for words: the file is closed all the same."""

    class Mute(Exception):
        def __str__(self) -> str:
            raise MemoryError

    def broken(_: Any) -> None:
        raise Mute

    recorder = Recorder(tmp_path / "run.mcap", robot)
    number = recorder._file._file.fileno()
    monkeypatch.setattr(recorder._file, "write", broken)
    until = time.monotonic() + PATIENCE
    while recorder.failed is None:
        assert time.monotonic() < until
        recorder.row(*rows(0))
    assert recorder.failed == f"The log {recorder.path} stopped."
    recorder.close()
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(number)


def test_a_sync_that_fails_last_is_told_when_the_recorder_closes(
    tmp_path: Path, robot: Robot, rows: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The kernel tells it once: the sync at the end seems to do well, and what was lost would be lost in silence."""
    errors = [OSError(errno.EIO, "Input/output error")]

    def broken_once(_: int) -> None:
        if errors:
            raise errors.pop()

    recorder = Recorder(tmp_path / "run.mcap", robot)
    monkeypatch.setattr("armlab.log.recording.file.os.fsync", broken_once)
    recorder.row(*rows(0))
    recorder._syncing.ask()
    recorder._syncing._thread.join(PATIENCE)
    recorder.close()
    assert str(recorder.failed).endswith("Input/output error.")


def test_waiting_instead_of_dropping(
    tmp_path: Path, robot: Robot, rows: Callable, disk: Callable[[], Stalled], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A link in lockstep keeps no real time: nothing may be lost."""
    sample, count = rows(0), 2 * QUEUE_ROWS + 1  # the thread that hangs in the disk has taken a full queue at most
    with Recorder(tmp_path / "run.mcap", robot, wait=True) as recorder:
        disk().gate.clear()
        waited = SimpleNamespace(monotonic=time.monotonic, sleep=lambda _: disk().gate.set())
        monkeypatch.setattr("armlab.log.recording.recorder.time", waited)  # the disk comes back once row() waits
        for i in range(count):
            assert recorder.row(sample[0], None, sample[2]._replace(number=i))
    assert disk().gate.is_set()
    assert recorder.dropped == 0
    assert len(read(recorder.path, raw=True)) == count
