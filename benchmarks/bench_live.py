"""Live view of a bridge: its cost, its delay, and its effect on the loop."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from blocks import Contender, Figure, Table, alternate, figures, table

from armlab import robots
from armlab.bridge.cell import parse_cell, run_cell
from armlab.bridge.control.loop import Controller
from armlab.kinematics import forward
from armlab.state import Command, State

ROBOTS = ("yumi_left", "yumi_right")
BROWSERS = (None, 0, 1, 4)  # None: no view
CPU, BEHIND = 2.0, 3.0  # relative to one browser: processor time and delay with four
LONGEST = 120.0  # s, maximum duration of a run
SETTLE = 3.0  # s excluded after the browsers connect, while the scene is sent
BROWSER = """
import json, sys, time
import msgspec, zstandard
from viser import __version__
from websockets.sync.client import connect
from websockets.typing import Subprotocol

port, seconds = int(sys.argv[1]), float(sys.argv[2])
unpack, end, seen = zstandard.ZstdDecompressor(), time.time() + seconds, []
size = {"image_width": 800, "image_height": 600, "fov": 0.8, "near": 0.01, "far": 1000.0}
camera = {"type": "ViewerCameraMessage", "wxyz": (1.0, 0.0, 0.0, 0.0), "position": (2.0, 1.0, 1.0), **size}
words = {"subprotocols": [Subprotocol(f"viser-v{__version__}")], "max_size": None, "compression": None}
with connect(f"ws://127.0.0.1:{port}", **words) as server:
    server.send(msgspec.msgpack.encode({**camera, "look_at": (0.0, 0.0, 0.0), "up_direction": (0.0, 0.0, 1.0)}))
    while time.time() < end:
        try:
            data = server.recv(timeout=0.5)
        except TimeoutError:
            continue
        size = int.from_bytes(data[8:16], "little")
        for message in msgspec.msgpack.decode(unpack.decompress(data[16 : 16 + size]))["messages"]:
            if message["type"] == "SetPositionMessage" and message["name"] == "/yumi_left/force":
                seen.append((time.time(), *message["position"]))
json.dump(seen, sys.stdout)
"""
CELL = "\n".join(f'[[robots]]\nname = "{name}"\nlink = "sim://{name}"' for name in ROBOTS)


class Found(NamedTuple):
    """One run: processor time of the view per second, picture delays [s], latencies, missed ticks."""

    cpu: float
    behind: np.ndarray
    latency: np.ndarray
    missed: int
    ticks: int


def run(quick: bool) -> list[Table]:
    """Measure runs without a view, and with a view in zero, one and four browsers."""
    rounds, seconds = (1, 4.0) if quick else (2, 5.0)
    runs: dict[int | None, list[Found]] = {count: [] for count in BROWSERS}
    for _ in range(rounds):
        for count, found in runs.items():
            found.append(_run(count, seconds))
    text = (
        "Two arms simulated in real time at 250 Hz; their controller sways both and returns a wrench with its "
        "covariance. The view updates the scene 30 times and the curves ten times per second. The browsers are "
        "programs that receive "
        "and unpack all data but draw nothing, so drawing does not take cores from the loop. The simulator, "
        f"loop, view and browsers share the machine. {seconds:g} s per run."
    )

    def contender(count: int | None, field: str, bar: float | None = None) -> Contender:
        values = iter([np.atleast_1d(getattr(one, field)) for one in runs[count]])
        missed, ticks = (sum(getattr(one, what) for one in runs[count]) for what in ("missed", "ticks"))
        note, over = f"{missed} of {ticks} ticks missed", "" if bar is None else _name(1)
        return Contender(_name(count), lambda: next(values), "armlab", bar, note, over)

    shown = [count for count in BROWSERS if count is not None]
    cpu = [contender(count, "cpu", CPU if count == 4 else None) for count in shown]
    behind = [contender(count, "behind", BEHIND if count == 4 else None) for count in shown if count]
    worst = "Worst delay in a run, from the robot packet to the browser."
    loop = [contender(count, "latency") for count in BROWSERS]
    behind_title, loop_title = "Live view: how far the picture is behind", "Live view: from packet to reply of the loop"
    return [
        table("Live view: processor time per second", text, "ms", cpu, rounds, warm=False),
        Table(behind_title, f"{worst} {text}", "ms", _worst(behind, rounds), rounds),
        table(loop_title, text, "µs", loop, rounds, warm=False),
    ]


def _worst(contenders: list[Contender], rounds: int) -> tuple[Figure, ...]:
    return figures(contenders, alternate(contenders, rounds, warm=False), np.max)


def _name(count: int | None) -> str:
    return "no view" if count is None else f"{count or 'no'} browser{'s' * (count != 1)}"


def _controller(over: threading.Event) -> Controller:
    record = {"wrench_hat": np.array([5.0, 0.0, 3.0, 0.0, 0.1, 0.0]), "wrench_hat_cov": 0.1 * np.eye(6)}

    def step(state: State) -> Any:
        speed = 0.1 * np.sin(1e-9 * state.t_receive % (2.0 * np.pi))
        commands = tuple(Command(qd=np.full(len(arm.q), speed), record=record) for arm in state.arms)
        return Command.stop() if over.is_set() else commands

    return step


def _run(count: int | None, seconds: float) -> Found:
    with ExitStack() as opened:
        os.environ["XDG_RUNTIME_DIR"] = opened.enter_context(tempfile.TemporaryDirectory())
        told: dict[str, Any] = {}
        over = threading.Event()

        def look() -> None:
            try:
                told.update(_look(opened, count, seconds))
            finally:
                over.set()

        threads: list[threading.Thread] = []

        def begin(_: str) -> None:
            threads.append(threading.Thread(target=look, daemon=True))
            threads[0].start()

        found = run_cell(parse_cell(CELL), seconds=LONGEST, patience=30.0, controller=_controller(over), ready=begin)
        threads[0].join()
    left = found.arms[0]
    table_, statistics = left.table, left.statistics
    answered = table_["send_ns"] > 0
    latency = 1e-9 * (table_["send_ns"] - table_["receive_ns"])[answered]
    behind = [_behind(seen, table_) for seen in told.get("seen", ())]
    return Found(
        told.get("cpu", 0.0),
        np.concatenate(behind) if behind else np.zeros(0),
        latency,
        statistics["missed"] + statistics["late"],
        len(table_),
    )


def _look(opened: ExitStack, count: int | None, seconds: float) -> dict[str, Any]:
    """Start a view and browsers; return the cost of the view and the data received by the browsers."""
    if count is None:
        time.sleep(SETTLE + seconds)
        return {}
    words = [sys.executable, "-m", "armlab", "view", "--live", "--port", "0"]
    view = opened.enter_context(subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True))
    opened.callback(view.kill)
    assert view.stdout is not None
    port = view.stdout.readline().strip().rpartition(":")[2]
    command = [sys.executable, "-c", BROWSER, port, str(SETTLE + seconds)]
    browsers = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(count or 0)]
    time.sleep(SETTLE)
    before, began = _seconds(view.pid), time.monotonic()
    time.sleep(seconds)
    cpu = (_seconds(view.pid) - before) / (time.monotonic() - began)
    seen = [np.array(msg) for msg in map(_output, browsers) if msg]
    return {"cpu": cpu, "seen": seen}


def _output(browser: subprocess.Popen[str]) -> list[list[float]]:
    return json.loads(browser.communicate(timeout=30.0)[0])


def _seconds(process: int) -> float:
    """Return processor time of a process [s]."""
    words = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")


def _behind(seen: np.ndarray, rows: Any) -> np.ndarray:
    """Return the delay [s] from each packet to the picture of its tool force.

    Measured positions are noisy, so each picture can be matched to an earlier packet.
    """
    came = 1e-9 * rows["receive_ns"]
    tool = forward(robots.load(ROBOTS[0]), np.ascontiguousarray(rows["q"]))[:, :3, 3]
    found = []
    for t, *point in seen[seen[:, 0] > seen[0, 0] + SETTLE]:
        window = np.flatnonzero((came <= t) & (came > t - 3.0))
        off = np.abs(tool[window] - point).max(axis=1)
        if len(window) and off.min() < 1e-7:
            found.append(t - came[window[np.flatnonzero(off < 1e-7)[-1]]])
    return np.array(found)
