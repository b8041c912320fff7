"""armlab record: every packet is kept, nothing is sent."""

from __future__ import annotations

import errno
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import log, robots
from armlab.cli import main
from armlab.errors import LogError
from armlab.wire.egm.robot_side import RobotMessage, RobotSideCodec

START_NS = 1_700_000_000_000_000_000


def free_ports(count: int) -> list[int]:
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(count)]
    for one in sockets:
        one.bind(("127.0.0.1", 0))
    ports = [one.getsockname()[1] for one in sockets]
    for one in sockets:
        one.close()
    return ports


class Streaming:
    """A robot's controller that streams packets to a port, and counts what comes back."""

    def __init__(self, name: str, port: int, mci: int = 2, q: Any = None) -> None:
        robot = robots.load(name)
        self.codec, self.mci, self.to = RobotSideCodec(robot), mci, ("127.0.0.1", port)
        self.q = np.array(robot.q_home) if q is None else np.asarray(q)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.sent = 0

    def send(self) -> None:
        k = self.sent
        message = RobotMessage(
            seqno=k, tm_ms=4 * k, q=self.q, q_planned=self.q, robot_ns=START_NS + 4_000_000 * k, mci=self.mci
        )
        self.socket.sendto(self.codec.encode_robot(message), self.to)
        self.sent += 1

    def came_back(self) -> int:
        self.socket.setblocking(False)
        try:
            self.socket.recv(65535)
        except BlockingIOError:
            return 0
        return 1


@pytest.fixture
def streaming() -> Iterator[Any]:
    """Streams from a thread, 250 Hz as robots do, until the test ends: the kernel holds what comes while all waits."""
    over, threads, peers = threading.Event(), [], []

    def begin(*made: Streaming) -> None:
        def play() -> None:
            while not over.wait(0.004):
                for one in made:
                    one.send()

        peers.extend(made)
        threads.append(threading.Thread(target=play, daemon=True))
        threads[-1].start()

    yield begin
    over.set()
    for thread in threads:
        thread.join(10)
    for peer in peers:
        peer.socket.close()


def test_two_arms_are_recorded_and_nothing_is_sent(tmp_path: Path, streaming: Any, command) -> None:
    ports = free_ports(2)
    elsewhere = robots.load("yumi_right").q_home + np.array([0, 0, 0.2, 0, 0, 0, 0])
    left, right = Streaming("yumi_left", ports[0]), Streaming("yumi_right", ports[1], q=elsewhere)
    streaming(left, right)
    words = ["--port", ",".join(map(str, ports)), "--lead-through", "-o", str(tmp_path / "run.mcap")]
    said = command(["record", "yumi_left", "yumi_right", *words, "--seconds", "0.4"])
    for side, peer in (("left", left), ("right", right)):
        table = log.read(tmp_path / f"run{side}.mcap")
        assert len(table) >= 25
        assert (np.diff(table["seq"]) == 1).all()
        assert table["q"][-1] == pytest.approx(peer.q, abs=1e-9)
        assert "q_sent" not in table.names
        assert f"run{side}.mcap: {len(table)} packets" in said.out
        assert peer.came_back() == 0
    assert "Manual mode, motors off" in said.err
    assert "yumi_right does not begin in its home posture: joint 3 is 0.20" in said.err
    assert "yumi_left does not begin" not in said.err


def test_an_arm_that_waits_for_references_gets_none_but_is_told_of(tmp_path: Path, streaming: Any, capsys: Any) -> None:
    (port,) = free_ports(1)
    peer = Streaming("yumi_left", port, mci=3)
    streaming(peer)
    words = ["--port", str(port), "-o", str(tmp_path / "run.mcap"), "--seconds", "0.1"]
    assert main(["record", "yumi_left", *words]) == 0
    assert peer.came_back() == 0
    assert capsys.readouterr().err.count("waits for references") == 1


def written(path: Path) -> int:
    """Number of rows that a recording which is being written shows to others."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it is not finished
        try:
            return len(log.read(path))
        except LogError:  # not begun
            return 0


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGKILL, marks=pytest.mark.slow)])
def test_a_recording_that_is_ended_from_outside(tmp_path: Path, number: signal.Signals) -> None:
    """Only a process that is killed outright may lose packets, those that it had not taken up."""
    (port,), path = free_ports(1), tmp_path / "run.mcap"
    command = [sys.executable, "-m", "armlab", "record", "yumi_left", "--port", str(port), "-o", str(path)]
    peer = Streaming("yumi_left", port)
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        assert f"Listening on UDP port {port}" in process.stderr.readline()
        while not path.exists():
            time.sleep(0.01)
        begun = time.monotonic()
        while time.monotonic() - begun < 0.3:
            peer.send()
            time.sleep(0.002)
        if number == signal.SIGKILL:
            while written(path) < peer.sent - 1 and time.monotonic() - begun < 60.0:
                time.sleep(0.05)  # nothing more comes, and it writes down what it has taken up without being asked
        else:
            time.sleep(0.2)  # the last packet is on its way through the kernel no longer
        os.kill(process.pid, number)
        try:
            process.communicate(timeout=30)
        finally:
            process.kill()
    expected = -number if number == signal.SIGKILL else 0
    assert process.returncode == expected
    if number == signal.SIGKILL:
        with pytest.warns(UserWarning, match="was not finished"):
            log.read(path)
        table = log.recover(path).path
        assert log.read(table)["seq"][0] == 0
        assert len(log.read(table)) >= peer.sent - 1  # the others had been written down
    else:
        seq = log.read(path)["seq"]
        assert (seq[0], seq[-1], len(seq)) == (0, peer.sent - 1, peer.sent)
    assert peer.came_back() == 0
    peer.socket.close()


@pytest.mark.parametrize("step", ["write", "finish"])
def test_a_full_disk(tmp_path: Path, streaming: Any, capsys: Any, monkeypatch: pytest.MonkeyPatch, step: str) -> None:
    """It is told while the robot still streams, at the latest at the end, and the exit code says that it failed."""

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(f"armlab.log.recording.file.RecordingFile.{step}", full)
    (port,) = free_ports(1)
    streaming(Streaming("yumi_left", port))
    words = ["--port", str(port), "-o", str(tmp_path / "run.mcap"), "--seconds", "0.2"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the log is not finished
        assert main(["record", "yumi_left", *words]) == 1
    said = capsys.readouterr().err
    assert "No packet came" not in said
    assert said.count("The recording stopped: The log") == 1
    assert "No space left on device" in said


def test_no_robot(tmp_path: Path, command) -> None:
    (port,) = free_ports(1)
    words = ["--port", str(port), "-o", str(tmp_path / "run.mcap"), "--patience", "0.1"]
    said = command(["record", "yumi_left", *words], 1).err
    assert "Expected packets from a robot within 0.1 s" in said
    assert "armlab doctor" in said
    assert not list(tmp_path.iterdir())
