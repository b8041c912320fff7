"""``armlab monitor``: its table, and the program over a local feed."""

from __future__ import annotations

import io
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from armlab import robots
from armlab.bridge.servers.hub import OPERATOR, Exchange
from armlab.bridge.servers.local import socket_path
from armlab.bridge.servers.local_server import LocalServer
from armlab.bridge.servers.row import RowSchema, RowWriter, read_row
from armlab.bridge.servers.watch import Watch
from armlab.cli import main
from armlab.cli.monitor import monitor, table
from armlab.log import Tick
from armlab.state import State

LEFT, RIGHT = robots.load("yumi_left"), robots.load("yumi_right")
NOW = 10**18


def row() -> Any:
    q, schema = np.zeros(7), RowSchema.of([LEFT, RIGHT])
    state = State(0.0, 0.004, q, q, q, robot="yumi_left", motors=1, rapid=2, mci=3)
    return read_row(schema, RowWriter(schema).row(state, None, Tick(1, 1, NOW, NOW, NOW + 1000, 0), 0, "labcomm a"))


def test_the_table() -> None:
    watch, console = Watch(), Console(width=100, file=io.StringIO())
    console.print(table(watch, NOW))
    watch.take({"kind": "about", "cell": "yumi"})
    watch.take({"kind": "event", "stamp_ns": NOW, "text": "[b]The robot[/b] is ready."})
    watch.take({"kind": "status", "rows": 1, "lost": 4, "arms": {}})
    watch.take(row())
    console.print(table(watch, NOW))
    text = console.file.getvalue()  # type: ignore[attr-defined]
    for word in (
        "No row yet",
        "Cell yumi",
        "yumi_right",
        "p50 / p99 / max [us]",
        "[b]The robot[/b] is ready.",
        "Rows lost by this feed: 4",
    ):
        assert word in text


@pytest.mark.parametrize("seconds", ["-1", "nan"])
def test_a_time_that_is_none(capsys: Any, seconds: str) -> None:
    assert main(["monitor", "--seconds", seconds]) == 2
    assert "seconds of at least 0" in capsys.readouterr().err


def test_plain_lines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    """Without a terminal: a line per arm and second, and the events."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    exchange = Exchange([LEFT], [OPERATOR])
    far = exchange.open(OPERATOR)
    server = threading.Thread(target=LocalServer(far, socket_path("small")).run, daemon=True)
    server.start()
    exchange.event("Something happened.")
    over = threading.Event()

    def rows() -> None:
        q = np.zeros(7)
        while not over.is_set():
            state = State(0.0, 0.004, q, q, q, robot="yumi_left", motors=1, mci=3)
            exchange.row(state, None, Tick(0, 0, time.time_ns(), time.time_ns(), time.time_ns(), 0))
            time.sleep(0.02)

    feeder = threading.Thread(target=rows, daemon=True)
    feeder.start()
    assert main(["monitor", "--seconds", "1"]) == 0
    shown = capsys.readouterr().out
    over.set()
    feeder.join()
    exchange.close()
    server.join(10.0)
    far.close()
    assert "yumi_left, state holding" in shown
    assert "Something happened." in shown
    assert callable(monitor)
    assert main(["monitor"]) == 1
    assert "found none" in capsys.readouterr().err


def test_a_bridge_elsewhere(capsys: Any) -> None:
    assert main(["monitor", "--zenoh", "http://host"]) != 0
    assert "zenoh://192.168.1.5:7447/lab1" in capsys.readouterr().err
