"""Recorder and its file: rows, readers while it grows, slow and full disks, kill -9, the end."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from armlab.errors import ConfigError, LogError, ShapeError, UnknownName
from armlab.lie import quaternion
from armlab.log import Column, Log, Recorder, inspect, read, recover
from armlab.log.mcap.records import contents
from armlab.log.recording.file import MAX_CHUNK_ROWS, PersistentFile, RecordingFile, recording_path
from armlab.log.recording.recorder import QUEUE_ROWS
from armlab.log.recording.rows import RowLayout
from armlab.robots import Robot
from armlab.state import Command

PATIENCE = 20.0  # s: only a failing test waits this long


def event_texts(path: Path) -> list[str]:
    return [event.text for event in inspect(path).events]


def until(done: Callable[[], object], meanwhile: Callable[[], object] = lambda: time.sleep(0.001)) -> None:
    end = time.monotonic() + PATIENCE
    while not done():
        assert time.monotonic() < end
        meanwhile()


def test_what_cannot_be_recorded_is_refused_at_once(tmp_path: Path, robot: Robot) -> None:
    wrong = [("mine", Column(shape=(3,)), "unit"), ("word", Column(unit="1", kind="text"), "text")]
    wrong += [("q", Column(shape=(7,)), "new names"), ("mine", Column(unit="1", kind="odd"), "kind")]
    for name, column, message in wrong:
        with pytest.raises((ShapeError, UnknownName), match=message):
            Recorder(tmp_path / "run.mcap", robot, extra={name: column})
    assert not list(tmp_path.iterdir())
    (tmp_path / "file").write_text("")
    with pytest.raises(LogError, match="Expected to create the log"):
        Recorder(tmp_path / "file" / "run.mcap", robot)


def test_row_never_raises_and_says_what_it_did_not_write(tmp_path: Path, robot: Robot, rows: Callable) -> None:
    with Recorder(tmp_path / "run.mcap", robot) as recorder:
        state, _, tick = rows(0)
        assert recorder.row(state, Command(record={"undeclared": 1.0}), tick)
        assert not recorder.row(state, Command(q=np.zeros(6)), rows(1)[2])
        assert not recorder.row(state, Command(record={"wrench_hat": "force"}), rows(2)[2])
        assert not recorder.row(None, None, rows(3)[2])  # type: ignore[arg-type]
        assert recorder.row(rows(4)[0], Command(record={"undeclared": 1.0}), rows(4)[2])
        assert (recorder.rows, recorder.dropped) == (2, 3)
    texts = event_texts(recorder.path)
    assert len([text for text in texts if "undeclared" in text]) == 1
    assert any("Expected 7 values in q_ref, got 6." in text for text in texts)
    assert any("3 rows dropped, ticks 1 to 3" in text for text in texts)
    assert len(read(recorder.path)) == 2


def test_text_that_is_no_utf8_does_not_end_the_recording(
    tmp_path: Path, robot: Robot, rows: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    half = "caf\udce9"  # as Python reads a Latin-1 file name, and "\\udce9" in JSON
    monkeypatch.setattr(sys, "argv", ["armlab", "run", "--log", half])
    with Recorder(tmp_path / "run.mcap", robot, note=half, attachments={half: b"data"}) as recorder:
        state, command, tick = rows(0)
        assert recorder.row(state, replace(command, record={half: 1, 5: 2}), tick)
        recorder.event(f"{half} was refused", tick.stamp_ns)
        recorder.parameter(1, half, half, half, tick.stamp_ns)
        assert recorder.row(*rows(1))
    assert (recorder.failed, recorder.rows, recorder.dropped, len(read(recorder.path))) == (None, 2, 0, 2)
    held, escaped = inspect(recorder.path), r"caf\udce9"
    assert held.metadata["armlab"]["command"] == f"armlab run --log {escaped}"
    assert held.attachments[escaped] == b"data"
    undeclared = f"columns not written, because extra= does not declare them: 5, {escaped}"
    assert [event.text for event in held.events][1:3] == [undeclared, f"{escaped} was refused"]


def test_complaints_that_are_always_new_do_not_fill_the_disk(tmp_path: Path, robot: Robot, rows: Callable) -> None:
    with Recorder(tmp_path / "run.mcap", robot) as recorder:
        state, _, tick = rows(0)
        for i in range(300):
            assert not recorder.row(state, Command(q=f"up {i}"), tick)  # type: ignore[arg-type]
    texts = event_texts(recorder.path)
    assert len([text for text in texts if "row not written" in text]) == 100
    assert any("300 rows dropped" in text for text in texts)


def test_a_finished_file_is_read_by_rosbags_and_by_mcap(recording: Callable[..., Path], rows: Callable) -> None:
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory
    from rosbags.highlevel import AnyReader

    path, found = recording(40), {}
    with AnyReader([path]) as reader:
        for c, stamp, raw in reader.messages():
            found.setdefault(c.topic.rpartition("/")[2], []).append((stamp, reader.deserialize(raw, c.msgtype)))
    for i in range(40):
        state, command, tick = rows(i)
        stamp, message = found["joint_states"][i]
        assert message.name == [f"yumi_robr_joint_{k}" for k in range(1, 8)]
        assert np.array_equal(message.position, state.q)
        assert np.array_equal(message.effort, state.tau)
        assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == tick.stamp_ns == stamp
        covariance = found["wrench_hat"][i][1].covariance.reshape(6, 6)
        assert np.array_equal(covariance, command.record["wrench_hat_cov"])
        o = found["tcp_pose"][i][1].pose.orientation
        q = quaternion.from_matrix(state.T_frame_tool[:3, :3])
        assert np.sign(o.w) * np.array([o.w, o.x, o.y, o.z]) == pytest.approx(q * np.sign(q[0]), abs=1e-12)
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        assert {attachment.name for attachment in reader.iter_attachments()} == {"robot.toml", "summary.json"}
        decoded = list(reader.iter_decoded_messages())
    assert len(decoded) == sum(topic.messages for topic in inspect(path).topics)
    assert [message.tick for _, channel, _, message in decoded if channel.topic.endswith("/tick")] == list(range(40))


def test_closing_twice_and_rows_after_closing(tmp_path: Path, robot: Robot, rows: Callable) -> None:
    recorder = Recorder(tmp_path / "run.mcap", robot)
    recorder.row(*rows(0))
    recorder.event("hello", 5)
    recorder.close({"late": 3, "p99": np.float64(1.5), "bins": np.arange(2)})
    recorder.close()
    assert not recorder.row(*rows(1))
    held = inspect(recorder.path)
    assert held.summary == {"late": 3, "p99": 1.5, "bins": [0, 1], "rows": 1, "dropped": 0, "holes": []}
    assert (held.events[-1].text, held.events[-1].stamp_ns) == ("hello", 5)


PROGRAM = """
import sys, time
import numpy as np
from armlab import robots
from armlab.log import Recorder, Tick
from armlab.state import Command, State

path, period = sys.argv[1], float(sys.argv[2])
robot, rng = robots.load("yumi_right"), np.random.default_rng(1)
recorder = Recorder(path, robot, attachments={"robot.toml": b"the description"}, note="of a program")
recorder.event("connected", time.time_ns())
start, wall, i = time.monotonic(), time.time_ns(), 0
try:
    while True:
        q, qd, tau, sent = rng.normal(size=(4, 7))
        stamp = wall + i * 4_000_000
        state = State(i * 0.004, 0.004, q, qd, tau, seq=i, robot_ns=stamp, q_planned=q, wrench_raw=tau[:6])
        command = Command(q, qd, record={"wrench_hat": q[:6], "wrench_hat_cov": np.eye(6)})
        recorder.row(state, command, Tick(i, i, stamp, stamp, stamp + 1000, 500, q_sent=sent, clamped=np.zeros(7)))
        i += 1
        print(i, flush=True)  # after the row was queued: the parent's count never runs ahead
        time.sleep(max(0.0, start + i * period - time.monotonic()))
except KeyboardInterrupt:
    print(i, flush=True)
"""


def program(path: Path, period: float) -> subprocess.Popen[str]:
    """A process that records rows, prints their number, and leaves finishing to the recorder."""
    return subprocess.Popen([sys.executable, "-c", PROGRAM, str(path), str(period)], stdout=subprocess.PIPE, text=True)


def test_ctrl_c_leaves_a_complete_file_also_when_nobody_closes_the_recorder(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with program(path, 0.001) as child:
        assert child.stdout is not None
        while child.stdout.readline() != "100\n":
            pass
        child.send_signal(signal.SIGINT)
        rows = int(child.stdout.read().split()[-1])
        assert child.wait(20) == 0
    assert inspect(path).finished
    assert abs(len(read(path)) - rows) <= 1  # the row in progress when the signal came


def test_a_disk_that_is_slow_to_sync_holds_up_no_row(
    tmp_path: Path, robot: Robot, rows: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    gate, reached = threading.Event(), threading.Event()
    monkeypatch.setattr("armlab.log.recording.recorder.FLUSH_PERIOD", 0.0)
    recorder = Recorder(tmp_path / "run.mcap", robot)
    monkeypatch.setattr("armlab.log.recording.file.os.fsync", lambda _: (reached.set(), gate.wait(PATIENCE)))
    recorder.row(*rows(0))
    assert reached.wait(PATIENCE)
    for i in range(1, 5):
        recorder.row(*rows(i))
    until(lambda: recorder._file.rows == 5 and not recorder._file._chunk_rows)  # not while a chunk is closed
    with pytest.warns(UserWarning, match="not finished"):
        assert len(read(recorder.path)) == 5
    gate.set()
    recorder.close()
    assert inspect(recorder.path).finished


def test_an_error_whose_text_cannot_be_made_stops_the_recorder(
    tmp_path: Path, robot: Robot, rows: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Mute(Exception):
        def __str__(self) -> str:
            raise MemoryError

    def broken(_: Any) -> None:
        raise Mute

    recorder = Recorder(tmp_path / "run.mcap", robot)
    number = recorder._file._file.fileno()
    monkeypatch.setattr(recorder._file, "write", broken)
    until(lambda: recorder.failed, lambda: recorder.row(*rows(0)))
    assert recorder.failed == f"Recording to {recorder.path} stopped."
    recorder.close()
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(number)


@pytest.mark.parametrize("is_last", [False, True])
def test_a_sync_that_fails_stops_the_recorder(
    tmp_path: Path, robot: Robot, rows: Callable, monkeypatch: pytest.MonkeyPatch, is_last: bool
) -> None:
    """The kernel reports the error once: the final sync seems to succeed, and the loss would go unnoticed."""
    errors = [OSError(errno.EIO, "Input/output error")]

    def broken_once(_: int) -> None:
        if errors:
            raise errors.pop()

    monkeypatch.setattr("armlab.log.recording.recorder.FLUSH_PERIOD", 1e9 if is_last else 0.0)
    recorder = Recorder(tmp_path / "run.mcap", robot)
    monkeypatch.setattr("armlab.log.recording.file.os.fsync", broken_once)
    recorder.row(*rows(0))
    if is_last:
        recorder._syncing.ask()
        recorder._syncing._thread.join(PATIENCE)
    until(lambda: recorder.failed or is_last, lambda: recorder.row(*rows(0)))
    recorder.close()
    assert str(recorder.failed).endswith("Input/output error.")


def test_waiting_instead_of_dropping(
    tmp_path: Path, robot: Robot, rows: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    sample, count = rows(0), 2 * QUEUE_ROWS + 1  # the blocked writer thread has taken at most a full queue
    with Recorder(tmp_path / "run.mcap", robot, wait=True) as recorder:
        moves, write = threading.Event(), recorder._file.write
        monkeypatch.setattr(recorder._file, "write", lambda *rows: moves.wait(PATIENCE) and write(*rows))
        waited = SimpleNamespace(monotonic=time.monotonic, sleep=lambda _: moves.set())
        monkeypatch.setattr("armlab.log.recording.recorder.time", waited)  # the disk recovers once row() waits
        for i in range(count):
            assert recorder.row(sample[0], None, sample[2]._replace(number=i))
    assert moves.is_set()
    assert recorder.dropped == 0
    assert len(read(recorder.path, raw=True)) == count


def test_each_row_is_there_at_once_and_no_chunk_is_longer_than_a_second(
    tmp_path: Path, robot: Robot, rows: Callable
) -> None:
    layout = RowLayout(robot)
    file = RecordingFile(tmp_path / "run.mcap", robot, layout, {}, "")
    for i in range(MAX_CHUNK_ROWS + 20):
        file.write([layout.pack(*rows(i))])
        if i in (0, MAX_CHUNK_ROWS - 2, MAX_CHUNK_ROWS - 1, MAX_CHUNK_ROWS + 19):
            with pytest.warns(UserWarning, match=rf"recovered {i + 1} rows \(.*, 0 bytes truncated"):
                read(file.path)
    file.event("the last word", 1)
    file.abandon()
    assert inspect(file.path).events[-1].text == "the last word"
    assert [chunk.is_open for chunk in contents(memoryview(file.path.read_bytes())).chunks] == [False, True]


@pytest.mark.parametrize("name", ["run.csv", "run.parquet", "run", "run.mcap.csv"])
def test_a_recording_has_no_name_of_another_format(name: str, tmp_path: Path, robot: Robot) -> None:
    assert recording_path("run.MCAP") == Path("run.MCAP")
    for written in (recording_path, Log(robot).save, lambda path: Recorder(path, robot)):
        with pytest.raises(ConfigError, match=rf"the extension .mcap, got .*{name}\. Change the extension.*log\.write"):
            written(tmp_path / name)
    assert not list(tmp_path.iterdir())


def replace_it(file: PersistentFile, folder: Path) -> int:
    """Close the file and open another one, which gets its descriptor."""
    number = file.fileno()
    os.close(number)
    assert os.open(folder / "other", os.O_CREAT | os.O_WRONLY) == number
    return number


@pytest.mark.parametrize("replaced", [False, True])
def test_writing_goes_on_at_the_same_place(replaced: bool, tmp_path: Path) -> None:
    file = PersistentFile(tmp_path / "run")
    file.write(b"0123456789")
    file.seek(2)
    number = replace_it(file, tmp_path) if replaced else os.close(file.fileno())
    assert file.write(b"ab") == 2
    file.seek(4)
    file.truncate(8)
    os.fsync(file.fileno())
    assert (tmp_path / "run").read_bytes() == b"01ab4567"
    file.close()
    if number is not None:
        os.close(number)
        assert (tmp_path / "other").read_bytes() == b""


def test_a_file_of_somebody_else_is_neither_written_nor_closed(tmp_path: Path) -> None:
    file = PersistentFile(tmp_path / "run")
    number = replace_it(file, tmp_path)
    file.close()
    os.write(number, b"theirs")
    os.close(number)
    with pytest.raises(OSError, match="Bad file descriptor"):
        file.write(b"x")
    assert (tmp_path / "run").read_bytes() == b""
    file = PersistentFile(tmp_path / "run-2")
    os.close(file.fileno())
    (tmp_path / "run-2").rename(tmp_path / "moved")
    (tmp_path / "run-2").write_bytes(b"theirs")
    with pytest.raises(FileNotFoundError, match="its name belongs to another file"):
        file.write(b"x")
    assert (tmp_path / "run-2").read_bytes() == b"theirs"


MOST_ROWS = 25  # 0.1 s: rows are written every 0.04 s, and the writer thread may wait for a core


def kill_one(path: Path, seconds: float) -> tuple[int, int]:
    """Record in real time at 250 Hz, kill after some seconds; return rows recorded and rows lost."""
    with program(path, 0.004) as child:
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
    assert (held.finished, held.metadata["armlab"]["note"]) == (False, "of a program")
    assert held.attachments["robot.toml"] == b"the description"
    assert "connected" in event_texts(path)
    assert read(recover(path).path).sha256 == table.sha256
    return count, lost


@pytest.mark.parametrize(("number", "longest"), [(1, 0.6), pytest.param(8, 2.0, marks=pytest.mark.slow)])
def test_kill_9_loses_a_few_rows(tmp_path: Path, number: int, longest: float) -> None:
    rng, losses = np.random.default_rng(number), []
    for trial in range(number):
        count, lost = kill_one(tmp_path / f"run{trial}.mcap", rng.uniform(0.4, longest))
        assert count > 50
        losses.append(lost)
    assert max(losses) < MOST_ROWS
    assert np.median(losses) <= 12 or number < 6
