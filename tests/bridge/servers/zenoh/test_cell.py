"""Whole cells with a simulated robot in real time and clients over Zenoh."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab.bridge.cell import parse_cell
from armlab.bridge.servers.row import RowSchema, read_row
from armlab.bridge.servers.zenoh.keys import Attached, key
from armlab.bridge.servers.zenoh.session import Address, close_session, queried

from ..ros.ending import play
from .conftest import PATIENCE, free_port, until

CELL = """
commands = ["zenoh"]
[[robots]]
name = "yumi_left"
link = "sim://yumi_left"
[servers.zenoh]
port = {port}
"""


class Client:
    """Rows of the arm as they come, and commands to it."""

    def __init__(self, port: int, sender: bytes) -> None:
        self.session, self.sender, self.seq = Address("127.0.0.1", port).open(), sender, 0
        ((_, text),) = queried(self.session, key("lab", "yumi_left", "schema"), PATIENCE)
        self.schema, self.rows, self.answers = RowSchema.read(text), [], []
        for name, found in (("live", self.rows), ("answer/*", self.answers)):
            self.session.declare_subscriber(key("lab", "yumi_left", name), found.append)

    def last(self) -> Any:
        return read_row(self.schema, self.rows[-1].payload.to_bytes()).values

    def command(self, q: np.ndarray) -> None:
        self.seq += 1
        attached = Attached(self.sender, self.seq, 0).pack()
        self.session.put(key("lab", "yumi_left", "command/position"), q.tobytes(), attachment=attached)


def test_a_client_moves_the_arm_and_another_may_only_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    port, moved = free_port(), []

    def script() -> None:
        clients = [Client(port, sender) for sender in (b"a" * 16, b"b" * 16)]
        one, other = clients
        until(lambda: one.rows and one.last()["yumi_left.mci"] == 3)
        start = one.last()["yumi_left.q"]
        steps = iter(range(1, 10**6))

        def commanded() -> bool:
            step = next(steps)
            one.command(start + 0.02 * min(step / 100, 1.0) * np.eye(7)[3])
            if one.last()["yumi_left.commander"] == "zenoh 61616161616161616161616161616161" and not other.answers:
                other.command(start)  # not when the first has lost the arm: it was late, and this one would keep it
            moved.append(one.last()["yumi_left.q"][3] - start[3])
            return moved[-1] > 0.018 and bool(other.answers)

        until(commanded)
        assert (
            "is commanded by zenoh 61616161616161616161616161616161. You may read."
            in other.answers[0].payload.to_string()
        )
        assert one.last()["yumi_left.commander"] == "zenoh 61616161616161616161616161616161"
        for client in clients:
            close_session(client.session)

    run = play(monkeypatch, parse_cell(CELL.format(port=port)), script)
    assert max(moved) > 0.018
    clients = run.statistics["zenoh" if "zenoh" in run.statistics else "servers"]
    assert "yumi_left live" in str(clients)


STOPPED = """
import sys, time
from armlab.bridge.servers.zenoh.session import Address
from armlab.bridge.servers.zenoh.keys import key
session = Address("127.0.0.1", int(sys.argv[1])).open()
session.declare_subscriber(key("lab", "yumi_left", "*"), lambda sample: print("row", flush=True))
time.sleep(600)
"""


@pytest.mark.slow
def test_a_reader_that_stands_still_disturbs_nobody(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It reads every key and is stopped by a signal for 15 s, longer than its buffers last; then it is killed."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    port, gaps = free_port(), []

    def script() -> None:
        client = Client(port, b"a" * 16)
        until(lambda: client.rows)
        reader = subprocess.Popen([sys.executable, "-c", STOPPED, str(port)], stdout=subprocess.PIPE)
        assert reader.stdout is not None
        assert reader.stdout.readline() == b"row\n"
        os.kill(reader.pid, signal.SIGSTOP)
        ticks = [client.last()["yumi_left.tick"]]
        end = ticks[0] + 15 * 250
        del client.rows[:]

        until(lambda: client.rows and client.last()["yumi_left.tick"] >= end, patience=120.0)
        numbers = [read_row(client.schema, row.payload.to_bytes()).values["yumi_left.tick"] for row in client.rows]
        gaps.extend(np.diff(numbers).tolist())
        os.kill(reader.pid, signal.SIGCONT)
        reader.kill()
        reader.wait()
        reader.stdout.close()
        close_session(client.session)

    run = play(monkeypatch, parse_cell(CELL.format(port=port)), script)
    received, lost = len(gaps) + 1, sum(gap - 1 for gap in gaps)
    assert min(gaps) == 1, "in order"
    assert lost <= 0.001 * (received + lost), f"{lost} of {received + lost} lost"
    assert run.reason == "the controller ended the run"
