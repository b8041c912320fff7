"""From recorded columns to a table: clock, rows, columns; tables that grow in memory."""

from __future__ import annotations

import errno
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from armlab.errors import LogError, ShapeError, UnknownName
from armlab.log import Column, Log, Tail, inspect, read
from armlab.log.assembly import recording_clock
from armlab.log.recording.file import RecordingFile
from armlab.robots import Robot

STAMPS = 10**18 + np.arange(6) * 4_000_000


def test_the_robots_clock_where_it_always_advances() -> None:
    robot_ns = 5 * 10**18 + np.arange(6) * 4_032_000
    t, clock = recording_clock({"robot_ns": robot_ns, "session_t": np.arange(6) * 0.004032}, STAMPS)
    assert clock == "robot"
    assert t == pytest.approx(np.arange(6) * 0.004032, abs=1e-15)


@pytest.mark.parametrize("step", [-3_600_000_000_000, 3_600_000_000_000, -1_000_000])
def test_a_robot_clock_that_was_set_is_not_trusted(step: int) -> None:
    robot_ns = 5 * 10**18 + np.arange(6) * 4_032_000
    robot_ns[3:] += step - 4_032_000 * (step == -1_000_000)
    t, clock = recording_clock({"robot_ns": robot_ns, "session_t": np.arange(6) * 0.004032}, STAMPS)
    assert clock == "robot"
    assert t == pytest.approx(np.arange(6) * 0.004032)


def test_sessions_are_placed_by_the_stamps() -> None:
    session_t = np.array([1.0, 1.004, 1.008, 0.0, 0.004, 0.008])
    stamps = STAMPS + np.repeat([0, 2_000_000_000], 3)
    t, clock = recording_clock({"session_t": session_t, "session": np.repeat([1, 2], 3)}, stamps)
    assert clock == "robot"
    assert t == pytest.approx([0.0, 0.004, 0.008, 2.012, 2.016, 2.020])


def test_stamps_when_there_is_nothing_else() -> None:
    t, clock = recording_clock({}, STAMPS)
    assert clock == "bridge"
    assert t == pytest.approx(np.arange(6) * 0.004)
    assert len(recording_clock({}, STAMPS[:0])[0]) == 0


def test_pushed_values_become_columns_and_nothing_else(robot: Robot) -> None:
    log = Log(robot, extra={"fext": Column(shape=(6,), unit="N", frame="base")})
    for i in range(20):
        log.push(t=0.5 + i * 0.004, q=np.full(7, i), fext=np.arange(6) if i % 2 else np.full(6, np.nan))
    table = log.table()
    assert len(log) == len(table) == 20
    assert set(table.names) == {"q", "fext", "tick", "session"}
    assert table.t == pytest.approx(0.5 + np.arange(20) * 0.004)
    assert np.array_equal(table["q"][:, 3], np.arange(20))
    assert table.missing() == {"fext": (10, tuple(range(0, 20, 2)))}
    assert table.columns["fext"].frame == "base"


def test_the_table_stays_valid_while_pushing_goes_on(robot: Robot) -> None:
    log = Log(robot)
    log.push(t=0.0, q=np.zeros(7))
    before = log.table()
    for i in range(1, 1000):
        log.push(t=float(i), q=np.ones(7))
    assert len(before) == 1
    assert np.all(before["q"] == 0.0)
    assert len(log.table()) == 1000


def test_wrong_values_are_refused_before_anything_is_stored(robot: Robot, extra: dict[str, Column]) -> None:
    log = Log(robot, extra=extra)
    with pytest.raises(UnknownName, match=r"'force'.*fext"):
        log.push(q=np.zeros(7), force=1.0)
    with pytest.raises(ShapeError, match="fext"):
        log.push(q=np.zeros(7), fext=np.zeros(5))
    assert len(log) == 0
    assert len(log.table()) == 0


def test_without_a_time_the_clock_is_the_call(robot: Robot) -> None:
    log = Log(robot)
    for _ in range(5):
        log.push(q=np.zeros(7))
    table = log.table()
    assert table.clock == "bridge"
    assert table.t[0] == 0.0
    assert np.all(np.diff(table.t) > 0)


def test_memory_and_file_hold_the_same(
    robot: Robot, rows: Callable, recording: Callable[..., Path], extra: dict[str, Column]
) -> None:
    log = Log(robot, extra)
    for i in range(30):
        log.row(*rows(i))
    memory, file = log.table(), read(recording(30))
    assert set(memory.names) == set(file.names)
    assert np.array_equal(memory["q"], file["q"])
    both = [name for name in memory.names if name != "T_frame_tool"]  # a pose goes through a quaternion in the file
    assert memory.select(*both).sha256 == file.select(*both).sha256
    assert memory["T_frame_tool"] == pytest.approx(file["T_frame_tool"], abs=1e-14)


def test_saved_rows_are_a_finished_recording(tmp_path: Path, robot: Robot, extra: dict[str, Column]) -> None:
    log = Log(robot, extra)
    for i in range(300):
        log.push(t=1.0 + i * 0.004, q=np.full(7, i), tick=i % 3, fext=np.full(6, np.nan if i < 50 else i))
    paths = [log.save(tmp_path / "logs" / "run.mcap", note="by hand") for _ in range(2)]
    assert [path.name for path in paths] == ["run.mcap", "run-2.mcap"]
    assert inspect(paths[1]).finished
    assert inspect(paths[1]).metadata["armlab"]["note"] == "by hand"
    table = log.table()
    assert read(paths[1]).sha256 == table.sha256
    assert (read(paths[1]).clock, read(paths[1]).t0_ns) == (table.clock, table.t0_ns)


def test_a_full_disk_leaves_no_half_log(tmp_path: Path, robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    log = Log(robot)
    log.push(t=0.0, q=np.zeros(7))

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(RecordingFile, "finish", full)
    with pytest.raises(LogError, match=r"run\.mcap, got: No space left on device\."):
        log.save(tmp_path / "run.mcap")
    assert not list(tmp_path.iterdir())


def test_a_tail_keeps_the_last_seconds(robot: Robot, rows: Callable, extra: dict[str, Column]) -> None:
    tail = Tail(0.5, robot, extra)
    for i in range(400):
        tail.row(*rows(i))
    table = tail.table()
    assert table.t[-1] - table.t[0] <= 0.5
    assert table["seq"][-1] == 399 + 7
    assert len(table) == 125
    assert len(Tail(1.0, robot).table()) == 0
    assert tail.seconds == 0.5
