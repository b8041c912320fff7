"""``armlab monitor``: what it makes of the messages, and the program over a local feed."""

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
from armlab.bridge.feed import OPERATOR, Exchange
from armlab.bridge.local import socket_path
from armlab.bridge.local_server import LocalServer
from armlab.bridge.row import RowWriter, read_row
from armlab.bridge.row_schema import RowSchema
from armlab.cli import main
from armlab.cli.monitor import Watch, monitor
from armlab.errors import UnknownName
from armlab.log import Tick
from armlab.state import Command, State

LEFT, RIGHT = robots.load("yumi_left"), robots.load("yumi_right")
SCHEMA = RowSchema.of([LEFT, RIGHT])
NOW = 10**18


def row(command: Command | None = None, **fields: Any) -> Any:
    q = np.zeros(7)
    state = State(0.0, 0.004, q, q, q, robot="yumi_left", **{"motors": 1, "rapid": 2, "mci": 3, **fields})
    return read_row(SCHEMA, RowWriter(SCHEMA).row(state, command, Tick(1, 1, NOW, NOW, NOW + 1000, 0), 0, "labcomm a"))


def left(watch: Watch, now: int = NOW) -> dict[str, str]:
    return watch.arms(now)[0]


def test_states_in_words() -> None:
    watch = Watch("yumi_left")
    assert watch.arms(NOW) == []
    for expected, message in {
        "holding": row(),
        "running": row(Command(np.zeros(7))),
        "the motors are off": row(motors=2),
        "guidance has not begun (EGMRunJoint)": row(mci=2),
    }.items():
        watch.take(message)
        assert left(watch)["state"] == expected
    assert left(watch, NOW + 2 * 10**9)["state"] == "no packet for 2.0 s"
    assert left(watch)["commander"] == "labcomm a"
    assert left(watch)["force [N]"] == left(watch)["rate [Hz]"] == "-"


def test_numbers() -> None:
    watch = Watch()
    watch.take(row(wrench=np.arange(6.0)))
    arm = {"rate": 249.94, "p50": 99.6, "p99": 200.0, "longest": None, "missed": 3, "late": 1, "drops": 2}
    clamps = {"position": [0] * 7, "velocity": [0, 5, 0, 0, 0, 0, 0]}
    watch.take({"kind": "status", "rows": 1, "lost": 4, "arms": {"yumi_left": {**arm, "clamps": clamps}}})
    shown = left(watch)
    assert (shown["rate [Hz]"], shown["p50 / p99 / max [us]"]) == ("249.9", "100 / 200 / -")
    assert (shown["force [N]"], shown["moment [N m]"]) == ("0.0 1.0 2.0", "3.00 4.00 5.00")
    assert shown["clamps per joint"] == "velocity 0 5 0 0 0 0 0"
    assert len(watch.arms(NOW)) == 2
    assert watch.lines(NOW)[0].startswith("yumi_left, state holding, rate [Hz] 249.9")


def test_the_table(tmp_path: Path) -> None:
    file = tmp_path / "run.mcap"
    file.write_bytes(bytes(2_000_000))
    watch, console = Watch(), Console(width=100, file=io.StringIO())
    console.print(watch.table(NOW))
    watch.take({"kind": "about", "cell": "yumi"})
    watch.take({"kind": "recording", "files": [str(file), str(tmp_path / "none.mcap")]})
    watch.take({"kind": "event", "stamp_ns": NOW, "text": "The robot is ready."})
    watch.take({"kind": "status", "rows": 1, "lost": 4, "arms": {}})
    watch.take({"kind": "parameters", "parameters": []})
    watch.take(row())
    assert "2.0 MB" in watch.recording()
    console.print(watch.table(NOW))
    text = console.file.getvalue()  # type: ignore[attr-defined]
    for word in (
        "No row yet",
        "Cell yumi",
        "yumi_right",
        "p50 / p99 / max [us]",
        "The robot is ready.",
        "Rows lost by this feed: 4",
    ):
        assert word in text


def test_an_arm_that_is_not_there() -> None:
    with pytest.raises(UnknownName, match="yumi_left"):
        Watch("ur5e").take(row())


@pytest.mark.parametrize("seconds", ["-1", "nan"])
def test_a_time_that_is_none(capsys: Any, seconds: str) -> None:
    assert main(["monitor", "--seconds", seconds]) == 1
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
