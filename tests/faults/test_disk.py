"""A full, read-only or slow disk, and low memory, while the arm moves; in virtual time."""

from __future__ import annotations

import errno
import os
import resource
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab.errors import LogError
from armlab.log import Table, inspect, read
from armlab.log.recording import file as recording_file

from .bench import Bench, Motion, Outcome, log_is_what_was_sent, met_in_motion, within_limits
from .matrix import Cell, shows

AT = 0.3  # s, when the fault begins
PATIENCE = 20.0  # s of the real clock; only a test that fails waits so long


class Disk:
    """A file that fails or hangs on demand; a failing file first writes half of the data."""

    def __init__(self, file: Any) -> None:
        self.file = file
        self.error: BaseException | None = None
        self.size = 0  # before it failed
        self.moves, self.reached = threading.Event(), threading.Event()
        self.moves.set()

    def write(self, data: bytes) -> int:
        if self.error is not None or not self.moves.is_set():
            self.reached.set()
        self.moves.wait(PATIENCE)
        if self.error is not None:
            self.size = os.fstat(self.file.fileno()).st_size
            self.file.write(data[: len(data) // 2])
            raise self.error
        return self.file.write(data)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.file, name)


@pytest.fixture
def disks(monkeypatch: pytest.MonkeyPatch) -> list[Disk]:
    """The files of the recordings."""
    made: list[Disk] = []
    real = recording_file.open_new

    def opened(path: Path) -> tuple[Disk, Path]:
        file, path = real(path)
        made.append(Disk(file))
        return made[-1], path

    monkeypatch.setattr(recording_file, "open_new", opened)
    return made


def motion(cell: Cell) -> Motion:
    if cell.state == "stopping":
        return Motion.that_stops(AT)
    return Motion(holds=(0.0, 0.6 if cell.state == "holding" else 0.0))


def read_unfinished(outcome: Outcome) -> Table:
    path = outcome.run.path
    with pytest.warns(UserWarning, match="not finished"):
        return read(path)


def log_ends(outcome: Outcome, bench: Bench, cell: Cell) -> None:
    """Check that the arm was not affected, and that the log is complete up to its end and marked as unfinished."""
    assert outcome.failure is None
    assert cell.is_told(outcome.told), outcome.told
    within_limits(bench)
    table = read_unfinished(outcome)
    assert 0 < len(table) < len(bench.sent)
    log_is_what_was_sent(bench, table, end=len(table))
    np.testing.assert_array_equal(table["tick"], np.arange(len(table)))
    lost = outcome.run.statistics["packets"] - len(table)
    assert f"The recording lost {lost} rows: the recorder had already stopped." in outcome.told


@shows
def test_the_log_ends_and_the_arm_goes_on(bench: Bench, cell: Cell, disks: list[Disk]) -> None:
    rows, code = 0, getattr(errno, cell.given, None)
    error = MemoryError() if code is None else OSError(code, os.strerror(code))

    def fail() -> None:
        nonlocal rows
        rows = bench.written(PATIENCE)
        disks[0].error = error

    bench.at[AT] = fail
    outcome = bench.run(motion(cell), seconds=0.7)
    log_ends(outcome, bench, cell)
    if cell.state == "stopping":
        met_in_motion(bench, AT)
    assert len(read_unfinished(outcome)) == rows > 50, "the log is complete up to the fault"
    assert outcome.run.path.stat().st_size == disks[0].size, "nothing is left of the failed write"
    count = len(bench.sent)
    again = bench.run(Motion(), seconds=0.1)
    within_limits(bench, count)
    log_is_what_was_sent(bench, again.table, count)


@contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """Make the kernel refuse larger files."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@shows
def test_the_kernel_refuses_more(bench: Bench, cell: Cell) -> None:
    bench.at[0.3] = lambda: bench.written(PATIENCE)  # otherwise all rows may be in one write, which fails as a whole
    with files_of_at_most(60_000):
        outcome = bench.run(motion(cell), seconds=1.0)
    log_ends(outcome, bench, cell)


@shows
def test_the_log_cannot_be_created(bench: Bench, cell: Cell, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(LogError) as caught:
        bench.link.run(lambda state: None, record=tmp_path / "file" / "run.mcap")
    assert cell.is_told(str(caught.value))
    assert not bench.sent
    assert bench.run(Motion(), seconds=0.1).failure is None


@shows
def test_a_disk_that_stands_still(bench: Bench, cell: Cell, disks: list[Disk]) -> None:
    bench.at[AT] = lambda: disks[0].moves.clear()
    if cell.state == "stopping":
        closing = threading.Thread(target=lambda: bench.closing(PATIENCE) and disks[0].moves.set())
        bench.at[0.4] = closing.start
    else:
        # The writer uses the wall clock, which runs slower here than the robot's.
        bench.at[0.7] = lambda: disks[0].reached.wait(PATIENCE) and disks[0].moves.set()
    outcome = bench.run(motion(cell), seconds=1.0)
    assert disks[0].reached.is_set()
    assert outcome.failure is None
    within_limits(bench)
    log_is_what_was_sent(bench, outcome.table)


@shows
def test_a_disk_that_stands_still_for_long(
    bench: Bench, cell: Cell, disks: list[Disk], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("armlab.log.recording.recorder.QUEUE_ROWS", 100)  # instead of ten seconds
    monkeypatch.setattr("armlab.log.recording.recorder.MANY_ROWS", 50)
    hangs = threading.Event()

    def stand_still() -> None:
        disks[0].moves.clear()
        hangs.set()

    def go_on() -> None:
        assert disks[0].reached.wait(PATIENCE)
        disks[0].moves.set()

    bench.at[0.3], bench.at[1.2] = stand_still, go_on
    outcome = bench.run(Motion(), seconds=1.5)
    assert hangs.is_set()
    assert outcome.failure is None
    assert cell.is_told(outcome.told), outcome.told
    within_limits(bench)
    path = outcome.run.path
    holes = inspect(path).summary["holes"]  # one more if the disk is slow to empty the queue
    table = read(path)
    kept = np.ones(len(bench.sent), dtype=bool)
    for first, last, _ in holes:
        kept[first : last + 1] = False
    np.testing.assert_array_equal(table["tick"], np.flatnonzero(kept))
    assert len(table) + sum(count for *_, count in holes) == outcome.run.statistics["packets"]
