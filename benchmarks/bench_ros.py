"""Servers that send rows to other programs: cost at 250 Hz, missing messages, and latency."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack
from typing import NamedTuple

import numpy as np
from blocks import Contender, Figure, Table, figures
from path_ends import PERIOD, ROBOT
from path_runs import PATIENCE, SETTLED, Reader, Received, Writer, usage
from ros_paths import WAYS, Way

from armlab import robots
from armlab.bridge.servers.hub import Hub
from armlab.bridge.servers.supervisor import Servers, server_command
from armlab.errors import ArmlabError
from armlab.log import Tick
from armlab.state import State

SHARE = 0.001  # allowed share of missing messages
CPU, LATENCY = 1.0, 1.3  # relative to a bare publisher: processor time; median latency


class Found(NamedTuple):
    """One run: processor time of the publisher per second, and messages received by the client."""

    cpu: float
    got: Received


def run(quick: bool) -> list[Table]:
    """Measure every path whose programs are installed, and a bare publisher of the same messages."""
    seconds, rounds = (3.0, 1) if quick else (4.0, 3)
    found: dict[str, list[tuple[Found, Found | None]]] = {}
    missing = []
    for name, make in WAYS.items():
        with ExitStack() as opened:
            way = make(opened)
            if way is None:
                missing.append(name)
            else:
                found[name] = [(_served(way, seconds), _bare(way, seconds)) for _ in range(rounds)]
    text = (
        "Joint states and wrenches of one arm at 250 Hz (zenoh, plotjuggler, labcomm, local: rows) from a loop "
        f"through the feed and a server process to a client process; {rounds} runs of {seconds:g} s, counted from 2 s "
        "after the first message. If none of n messages is missing, the true share is at most 3/n with 95 % "
        "confidence. The latency is measured from the stamp of the row to the client's callback. For comparison, after "
        "each run, a bare publisher sends the same messages to the same client for the same time without the loop, the "
        "feed or armlab. Its delay is that of the machine and the library. Processor time includes the server and all "
        "processes that it started. All processes share the machine's cores."
    )
    if missing:
        text += f" Not measured, because programs are missing: {', '.join(missing)}."

    def told(title: str, unit: str, bar: float | None, value: str, share: float = 50.0) -> Table:
        rows = [row for name, both in found.items() for row in _rows(name, both, bar, value, share)]
        return Table(f"Paths: {title}", text, unit, tuple(rows), rounds)

    return [
        told("messages missing or out of order", "%", SHARE, "missing"),
        told("processor time, share of one core", "%", CPU, "cpu"),
        told("latency, median", "µs", LATENCY, "latency"),
        told("latency, 99th percentile", "µs", None, "latency", 99.0),
    ]


def _rows(
    name: str, runs: Sequence[tuple[Found, Found | None]], bar: float | None, value: str, share: float
) -> tuple[Figure, ...]:
    """Return the table rows of one path: armlab, and the bare publisher with the ratio of the two."""
    served = [ours for ours, _ in runs]
    bare = [peer for _, peer in runs if peer is not None]
    values = [_values(side, value, share) for side in (served, bare) if side]
    counts = [_counts(side) for side in (served, bare) if side]
    judged = value == "missing"
    note = f"{counts[0]}, in order"
    if bare and value == "latency":
        note = f"{1e6 * np.median(np.subtract(*values)):+.0f} µs relative to the bare publisher"
    contenders = [Contender(name, lambda: np.zeros(0), "armlab", bar if judged else None, note)]
    if bare:
        ratio = None if judged else bar
        contenders.append(Contender(f"{name}: bare publisher", lambda: np.zeros(0), bar=ratio, note=counts[1]))
    return figures(contenders, [[np.array([one]) for one in side] for side in values])


def _values(runs: Sequence[Found], value: str, share: float) -> list[float]:
    """Return the value of each run; the share of missing messages is that of all runs together."""
    if value == "missing":
        return [1.0 - sum(one.got.received for one in runs) / sum(one.got.due for one in runs)]
    return [one.cpu if value == "cpu" else float(np.percentile(one.got.latency, share)) for one in runs]


def _counts(runs: Sequence[Found]) -> str:
    return f"{sum(one.got.received for one in runs)} of {sum(one.got.due for one in runs)} messages"


def _served(way: Way, seconds: float) -> Found:
    about = {"cell": "cell"}
    exchange, over = Hub([robots.load(ROBOT)], [way.server], about=about), threading.Event()
    sent: list[int] = []
    command = {way.server: server_command(way.server, way.options())}
    with Servers(exchange, command) as servers:
        servers.ready(PATIENCE)
        loop = threading.Thread(target=_loop, args=(exchange, over, sent))
        loop.start()
        try:
            with Reader(way.reader(round((seconds + SETTLED) / PERIOD)), way.environment) as reader:
                cpu = usage(servers.processes()[way.server], reader, seconds + PATIENCE)
                return Found(cpu, _received(way, reader, np.array(sent)))
        finally:
            over.set()
            loop.join()


def _bare(way: Way, seconds: float) -> Found | None:
    if way.writer is None:
        return None
    with (
        Writer(way.writer, way.environment) as writer,
        Reader(way.reader(round((seconds + SETTLED) / PERIOD)), way.environment) as reader,
    ):
        cpu = usage(writer.process.pid, reader, seconds + PATIENCE)
        return Found(cpu, _received(way, reader, writer.end()))


def _received(way: Way, reader: Reader, sent: np.ndarray) -> Received:
    if not reader.wait(PATIENCE):
        raise ArmlabError("Expected the reader to stop after receiving enough messages, but it is still running.")
    return reader.received(sent, way.kinds)


def _loop(exchange: Hub, over: threading.Event, sent: list[int]) -> None:
    """Publish a row every period until the end."""
    arm, due = robots.load(ROBOT), time.monotonic()
    q = np.array(arm.q_home)
    while not over.is_set():
        state = State(t=1.0, dt=PERIOD, q=q, qd=0.1 * q, tau=q, robot=ROBOT, wrench=np.arange(6.0))
        sent.append(time.time_ns())
        exchange.row(state, None, Tick(len(sent), len(sent), sent[-1], 1_000, 2_000, 3))
        due += PERIOD
        time.sleep(max(0.0, due - time.monotonic()))
