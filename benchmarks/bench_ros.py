"""ROS programs: what the server of each way costs at 250 Hz, what its client misses, and how late messages come."""

from __future__ import annotations

import os
import subprocess
import tempfile
import threading
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from blocks import Contender, Table, alternate, figures
from ros_paths import WAYS, Way

from armlab import robots
from armlab.bridge.feed import Exchange
from armlab.bridge.servers import Servers, server_command
from armlab.log import Tick
from armlab.state import State

PERIOD = 0.004  # s
SETTLED = 2.0  # s after the first message that do not count
CPU = 0.05  # s of one core per second, with one client
LATENCY = 0.35e-3  # s, median
ARM = "yumi_left"


class Found(NamedTuple):
    """One run: processor time of the server per second, latencies [s], messages received in order, and sent."""

    cpu: float
    latency: np.ndarray
    received: int
    sent: int


def run(quick: bool) -> list[Table]:
    """Measure every way whose programs are there."""
    rounds, seconds = (1, 4.0) if quick else (5, 12.0)
    with tempfile.TemporaryDirectory() as folder:
        ways = {name: way for name, make in WAYS.items() if (way := make(Path(folder))) is not None}
        found = {name: [_run(way, seconds) for _ in range(rounds + 1)] for name, way in ways.items()}  # one to warm up
    text = (
        "Joint states and wrenches of one arm at 250 Hz from a loop through the feed and a server, a process, to a "
        f"client, another process; {seconds:g} s a run, counted from 2 s after the first message. Latency is from the "
        "stamp of the row to the client's callback."
    )

    def contenders(field: str, bar: float | None) -> list[Contender]:
        told = []
        for name, runs in found.items():
            values = iter([np.atleast_1d(getattr(one, field)) for one in runs])
            received, sent = (sum(getattr(one, what) for one in runs) for what in ("received", "sent"))
            note = f"{received} of {sent} messages"
            told.append(Contender(name, lambda values=values: next(values), "armlab", bar, note))
        return told

    def told(title: str, unit: str, field: str, bar: float | None, share: float = 50.0) -> Table:
        one = contenders(field, bar)
        reduced = figures(one, alternate(one, rounds), lambda values: np.percentile(values, share))
        return Table(f"ROS: {title}", text, unit, reduced, rounds)

    return [
        told("processor time of the server per second", "ms", "cpu", CPU),
        told("latency, median", "µs", "latency", LATENCY),
        told("latency, 99th percentile", "µs", "latency", None, 99.0),
    ]


def _run(way: Way, seconds: float) -> Found:
    exchange, over = Exchange([robots.load(ARM)], [way.server], about={"cell": "benchmark"}), threading.Event()
    sent: list[int] = []
    count = round((seconds + SETTLED) / PERIOD)
    server = {way.server: server_command(way.server, way.options)}
    with tempfile.TemporaryFile() as out, Servers(exchange, server) as servers:  # a pipe that is full would stop it
        servers.ready()
        loop = threading.Thread(target=_loop, args=(exchange, over, sent))
        loop.start()
        try:
            environment = {**os.environ, **way.environment}
            client = subprocess.Popen(way.client(count), env=environment, stdout=out, stderr=subprocess.DEVNULL)
            time.sleep(SETTLED)
            before, began = _seconds(servers.processes()[way.server]), time.monotonic()
            time.sleep(seconds)
            cpu = (_seconds(servers.processes()[way.server]) - before) / (time.monotonic() - began)
            client.wait(60.0)
        finally:
            over.set()
            loop.join()
        out.seek(0)
        return _counted(cpu, out.read().decode(), sent)


def _counted(cpu: float, out: str, sent: list[int]) -> Found:
    """Return what a client's lines tell; a message out of order counts as missing."""
    received, latency = 0, []
    due = 0
    for kind in "JW":
        lines = np.array([line.split()[1:3] for line in out.splitlines() if line.startswith(kind)], dtype=np.int64)
        lines = lines[lines[:, 0] >= lines[0, 0] + round(1e9 * SETTLED)]
        due += sum(lines[0, 0] <= stamp <= lines[-1, 0] for stamp in sent)
        received += 1 + int(np.sum(np.diff(lines[:, 0]) > 0))
        latency.append(1e-9 * (lines[:, 1] - lines[:, 0]))
    return Found(cpu, np.concatenate(latency), received, due)


def _loop(exchange: Exchange, over: threading.Event, sent: list[int]) -> None:
    """Give a row every period until it is over."""
    arm, due = robots.load(ARM), time.monotonic()
    q = np.array(arm.q_home)
    while not over.is_set():
        state = State(t=1.0, dt=PERIOD, q=q, qd=0.1 * q, tau=q, robot=ARM, wrench=np.arange(6.0))
        sent.append(time.time_ns())
        exchange.row(state, None, Tick(len(sent), len(sent), sent[-1], 1_000, 2_000, 3))
        due += PERIOD
        time.sleep(max(0.0, due - time.monotonic()))


def _seconds(process: int) -> float:
    """Return processor time of a process [s]."""
    words = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")
