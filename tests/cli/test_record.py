"""armlab record: every packet is kept, nothing is sent."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import log, robots
from armlab.cli import main
from armlab.errors import LogError

from ..bridge.conftest import Peer
from ..processes import free_port


@pytest.fixture
def streaming() -> Iterator[Callable[..., None]]:
    """Stream packets from peers at 250 Hz, as robots do, until the test ends; the kernel queues them meanwhile."""
    over, threads, streamed = threading.Event(), [], []

    def begin(*peers: Peer, mci: int = 2) -> None:
        def play() -> None:
            while not over.wait(0.004):
                for one in peers:
                    one.send(mci=mci)

        streamed.extend(peers)
        threads.append(threading.Thread(target=play, daemon=True))
        threads[-1].start()

    yield begin
    over.set()
    for thread in threads:
        thread.join(10)
    for peer in streamed:
        peer.socket.close()


def test_two_arms_are_recorded_and_nothing_is_sent(tmp_path: Path, streaming: Any, command) -> None:
    ports = free_port(), free_port()
    left, right = (Peer(robots.load(f"yumi_{side}"), port) for side, port in zip(("left", "right"), ports, strict=True))
    right.packets.q[2] += 0.2
    streaming(left, right)
    words = ["--port", ",".join(map(str, ports)), "--lead-through", "-o", str(tmp_path / "run.mcap")]
    said = command(["record", "yumi_left", "yumi_right", *words, "--seconds", "0.4"])
    for side, peer in (("left", left), ("right", right)):
        table = log.read(tmp_path / f"run{side}.mcap")
        assert len(table) >= 25
        assert (np.diff(table["seq"]) == 1).all()
        assert table["q"][-1] == pytest.approx(peer.packets.q, abs=1e-9)
        assert "q_sent" not in table.names
        assert f"run{side}.mcap: {len(table)} packets" in said.out
        assert peer.surplus() == 0
    assert "manual mode with motors off" in said.err
    assert "yumi_right does not start in its home posture: joint 3 is 0.20" in said.err
    assert "yumi_left does not start" not in said.err


def test_an_arm_that_waits_for_references_gets_none_but_is_told_of(tmp_path: Path, streaming: Any, capsys: Any) -> None:
    port = free_port()
    peer = Peer(robots.load("yumi_left"), port)
    streaming(peer, mci=3)
    words = ["--port", str(port), "-o", str(tmp_path / "run.mcap"), "--seconds", "0.1"]
    assert main(["record", "yumi_left", *words]) == 0
    assert peer.surplus() == 0
    assert capsys.readouterr().err.count("waits for references") == 1


def written(path: Path) -> int:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the log is not finished
        try:
            return len(log.read(path))
        except LogError:  # not begun
            return 0


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGKILL, marks=pytest.mark.slow)])
def test_a_recording_that_is_ended_from_outside(tmp_path: Path, number: signal.Signals) -> None:
    """Only a process that is killed outright may lose packets: those it had not yet read."""
    port, path = free_port(), tmp_path / "run.mcap"
    command = [sys.executable, "-m", "armlab", "record", "yumi_left", "--port", str(port), "-o", str(path)]
    peer = Peer(robots.load("yumi_left"), port)
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        assert f"Listening on UDP port {port}" in process.stderr.readline()
        while not path.exists():
            time.sleep(0.01)
        begun = time.monotonic()
        while time.monotonic() - begun < 0.3:
            peer.send(mci=2)
            time.sleep(0.002)
        if number == signal.SIGKILL:
            while written(path) < peer.packets.seq - 1 and time.monotonic() - begun < 60.0:
                time.sleep(0.05)  # no more packets arrive; the recorder writes those it has read without being asked
        else:
            time.sleep(0.2)  # by now the last packet has passed through the kernel
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
        assert len(log.read(table)) >= peer.packets.seq - 1  # all but at most one had been written
    else:
        seq = log.read(path)["seq"]
        assert (seq[0], seq[-1], len(seq)) == (0, peer.packets.seq - 1, peer.packets.seq)
    assert peer.surplus() == 0
    peer.socket.close()


@pytest.mark.parametrize("step", ["write", "finish"])
def test_a_full_disk(tmp_path: Path, streaming: Any, capsys: Any, monkeypatch: pytest.MonkeyPatch, step: str) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(f"armlab.log.recording.file.RecordingFile.{step}", full)
    port = free_port()
    streaming(Peer(robots.load("yumi_left"), port))
    words = ["--port", str(port), "-o", str(tmp_path / "run.mcap"), "--seconds", "0.2"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the log is not finished
        assert main(["record", "yumi_left", *words]) == 1
    said = capsys.readouterr().err
    assert "No packets received" not in said
    assert said.count("The recording stopped: Recording to") == 1
    assert "No space left on device" in said


def test_no_robot(tmp_path: Path, command) -> None:
    words = ["--port", str(free_port()), "-o", str(tmp_path / "run.mcap"), "--patience", "0.1"]
    said = command(["record", "yumi_left", *words], 1).err
    assert "Expected packets from a robot within 0.1 s" in said
    assert "armlab doctor" in said
    assert not list(tmp_path.iterdir())
