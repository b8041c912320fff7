"""Bridge of a cell: latency that clients add to the loop, measured from the arrival of a packet to its reply."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack

import numpy as np
from blocks import Contender, Table, table

from armlab import bridge, robots
from armlab.bridge.cell import parse_cell, run_cell
from armlab.bridge.servers.local import LocalFeed
from armlab.bridge.servers.messages import Subscribe

ROBOT = "yumi_right"
IDLE = 10
BLOCK = 0.5  # s, length of a block with or without clients
SETTLE = 0.2  # s excluded after each change
CLIENTS = """
import selectors, socket, sys
idle, ports = int(sys.argv[1]), [int(port) for port in sys.argv[2:]]
selector, held = selectors.DefaultSelector(), []
selector.register(sys.stdin, selectors.EVENT_READ)
while True:
    for key, _ in selector.select():
        if key.fileobj is not sys.stdin:
            if key.fileobj.fileno() >= 0 and not key.fileobj.recv(65536):
                selector.unregister(key.fileobj)
            continue
        word = sys.stdin.readline()
        if not word:
            sys.exit()
        for one in held:
            if one in selector.get_map():
                selector.unregister(one)
            one.close()
        held = []
        if word == "on\\n":
            held = [socket.create_connection(("127.0.0.1", ports[k % len(ports)])) for k in range(idle + 1)]
            for one in held[:idle]:
                selector.register(one, selectors.EVENT_READ)
"""
BAR = 1.05  # factor on the median without clients
CELL = f"""
[[robots]]
name = "{ROBOT}"
link = "sim://{ROBOT}"
[servers.labcomm]
ports = {{{ROBOT} = 0}}
parameters = 0
rows = 0
"""


def run(quick: bool) -> list[Table]:
    """Measure a run of a cell whose LabComm clients connect only in some blocks, and the loop without servers."""
    rounds = 8 if quick else 30
    busy, free = _bridge(rounds)
    alone = iter(np.array_split(_alone(3.0 if quick else 10.0), rounds))
    contenders = [
        Contender("ten idle clients and one that never reads", lambda: next(busy), "armlab"),
        Contender("no clients", lambda: next(free), bar=BAR, note="with running servers"),
        Contender("no servers", lambda: next(alone), note="the loop alone, in a separate run"),
    ]
    text = (
        f"Median time from the arrival of a packet to its reply, by kernel time stamps. {ROBOT} is simulated in real "
        "time at 250 Hz, and the arm holds. In one run, LabComm clients connect to the ports of the arm and of the "
        f"fused rows, and disconnect. Blocks of {BLOCK:g} s with and without clients alternate, and each is compared "
        "with its neighbour. All but one client read every row. Simulator, servers, clients and loop share "
        "the machine's "
        "cores."
    )
    return [table("Bridge: what clients cost the loop", text, "µs", contenders, rounds, warm=False)]


def _bridge(rounds: int) -> tuple[Iterator[np.ndarray], Iterator[np.ndarray]]:
    """Return the latencies of the blocks with clients and of the blocks without clients in one run."""
    rng, began = np.random.default_rng(1), []
    order = [state for _ in range(rounds) for state in rng.permutation(["on", "off"])]
    with ExitStack() as opened:
        os.environ["XDG_RUNTIME_DIR"] = opened.enter_context(tempfile.TemporaryDirectory())

        def change(clients: subprocess.Popen[str]) -> None:
            assert clients.stdin is not None
            with LocalFeed(patience=20.0) as feed:  # wait until the robot sends
                feed.ask(Subscribe())
                while isinstance(feed.receive(), dict):
                    pass
            time.sleep(1.0)
            for state in order:
                clients.stdin.write(f"{state}\n")
                clients.stdin.flush()
                began.append(time.time_ns())
                time.sleep(SETTLE + BLOCK)

        def connect(line: str) -> None:
            ports = [port for port, name in re.findall(r":(\d+) \(labcomm, (\w+)\)", line) if name != "parameters"]
            words = [sys.executable, "-S", "-c", CLIENTS, str(IDLE), *ports]
            clients = opened.enter_context(subprocess.Popen(words, stdin=subprocess.PIPE, text=True))
            opened.callback(clients.kill)
            threading.Thread(target=change, args=(clients,), daemon=True).start()

        seconds = 4.0 + (SETTLE + BLOCK) * len(order)
        found = run_cell(parse_cell(CELL), seconds=seconds, patience=20.0, ready=connect)
    came, taken = found.table["receive_ns"], _latencies(found)
    blocks: dict[str, list[np.ndarray]] = {"on": [], "off": []}
    for state, start in zip(order, began, strict=True):
        inside = (came > start + 1e9 * SETTLE) & (came < start + 1e9 * (SETTLE + BLOCK)) & np.isfinite(taken)
        blocks[state].append(taken[inside])
    return iter(blocks["on"]), iter(blocks["off"])


def _alone(seconds: float) -> np.ndarray:
    with bridge.connect(f"sim://{ROBOT}", robots.load(ROBOT), patience=20.0) as link:
        found = _latencies(link.run(lambda state: None, seconds=seconds))[500:]
    return found[np.isfinite(found)]


def _latencies(run: bridge.Run) -> np.ndarray:
    """Return the time [s] from arrival to reply; NaN without a reply."""
    seconds = 1e-9 * (run.table["send_ns"] - run.table["receive_ns"])
    return np.where(run.table["send_ns"] > 0, seconds, np.nan)
