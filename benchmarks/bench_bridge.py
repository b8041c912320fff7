"""The bridge of a cell: what its clients cost the loop, from the arrival of a packet to its reply."""

from __future__ import annotations

import os
import re
import socket
import subprocess
import sys
import tempfile
from contextlib import ExitStack

import numpy as np
from blocks import Contender, Table, table

from armlab import bridge, robots
from armlab.bridge.cell import parse_cell, run_cell

ROBOT = "yumi_right"
IDLE = 10
SECONDS = 3.0
READERS = """
import selectors, socket, sys
selector = selectors.DefaultSelector()
for port in sys.argv[1:]:
    selector.register(socket.create_connection(("127.0.0.1", int(port))), selectors.EVENT_READ)
while sys.argv[1:]:
    for key, _ in selector.select():
        key.fileobj.recv(65536)
"""
SETTLE = 250  # packets at the beginning that do not count
BAR = 1.05  # of the median without clients
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
    """Measure runs of the same controller: with clients of the LabComm server, without any, and without servers."""
    contenders = [
        Contender("ten idle clients and one that never reads", lambda: _bridge(IDLE, 1), "armlab"),
        Contender("no clients", lambda: _bridge(0, 0), bar=BAR, note="servers run"),
        Contender("no servers", _alone, note="the loop alone"),
    ]
    text = (
        f"Median time from the arrival of a packet to its reply, {ROBOT} simulated in real time at 250 Hz, "
        f"{SECONDS:g} s per block, by kernel stamps; the arm holds. LabComm clients on the ports of the arm and of the "
        "fused rows; all but one read what comes. Simulator, servers, clients and loop share the machine's cores."
    )
    return [table("Bridge: what clients cost the loop", text, "µs", contenders, 3 if quick else 15)]


def _bridge(idle: int, deaf: int) -> np.ndarray:
    with ExitStack() as opened:
        os.environ["XDG_RUNTIME_DIR"] = opened.enter_context(tempfile.TemporaryDirectory())

        def connect(line: str) -> None:
            ports = [port for port, name in re.findall(r":(\d+) \(labcomm, (\w+)\)", line) if name != "parameters"]
            words = [ports[k % len(ports)] for k in range(idle)]
            reader = opened.enter_context(subprocess.Popen([sys.executable, "-S", "-c", READERS, *words]))
            opened.callback(reader.kill)
            for _ in range(deaf):
                opened.enter_context(socket.create_connection(("127.0.0.1", ports[0])))

        return _latencies(run_cell(parse_cell(CELL), seconds=SECONDS, patience=20.0, ready=connect))


def _alone() -> np.ndarray:
    with bridge.connect(f"sim://{ROBOT}", robots.load(ROBOT), patience=20.0) as link:
        return _latencies(link.run(lambda state: None, seconds=SECONDS))


def _latencies(run: bridge.Run) -> np.ndarray:
    seconds = 1e-9 * (run.table["send_ns"] - run.table["receive_ns"])
    return seconds[SETTLE:][run.table["send_ns"][SETTLE:] > 0]
