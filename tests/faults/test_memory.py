"""Memory that runs out for the whole process while the arm moves: a real process with a limit, in real time."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from armlab import bridge, log

from .bench import ROBOT
from .matrix import Cell, cells, shows
from .processes import PATIENCE, SimulatedRobot, free_port, is_whole, program, sway

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux", reason="other kernels do not bound the address space of a process"),
]

CONTROLLER = """
import resource
from pathlib import Path
import numpy as np
from armlab.log import Column
from armlab.state import Command
kept, since, wide = [], [], np.zeros(20_000)
def controller(state):
    if state.t < 0.3:
        return command(state)
    if not since:
        since.append(state.t)
        size = resource.getpagesize() * int(Path("/proc/self/statm").read_text().split()[0]) + 40_000_000
        resource.setrlimit(resource.RLIMIT_AS, (size, size))
    return goes_on(state)
def sways(state):
    return Command(state.q_start + 0.1 * (1.0 - np.cos(4.0 * state.t)))
def holds(state):
    return None
def keeps(state):
    for _ in range(200):  # a fraction of the cycle, also on a slow computer
        kept.append([float(k) for k in range(20)])
    return command(state)
def takes_all(state):
    try:
        while True:
            kept.append(bytearray(100))
    except MemoryError:
        return command(state)
def stops(state):
    takes_all(state)
    return Command.stop()
def records(state):
    return Command(sways(state).q, record={"wide": wide})
"""
EXTRA = 'extra = {"wide": Column((20_000,), "1")}'
REST = "the arm comes to rest, and the run ends; the log is finished"
CYCLE = "Expected a cycle without errors, got MemoryError: no memory is left."
NEXT = "the next run"


@shows(
    cells(
        "memory",
        "none is left in the process: the controller keeps what it makes",
        "holding, running",
        REST,
        "The controller raised MemoryError: no memory is left. The arm was stopped.",
        NEXT,
        "keeps",
    ),
    cells(
        "memory",
        "none is left in the process: the controller has taken it and goes on",
        "holding, running, stopping",
        REST,
        "MemoryError: no memory is left.",
        NEXT,
        "takes_all",
    ),
    cells(
        "memory",
        "none is left in the process: each row has 160 kB of the controller's own",
        "running",
        REST,
        CYCLE,
        NEXT,
        "records",
    ),
)
def test_no_memory_is_left(cell: Cell, tmp_path: Path) -> None:
    port = free_port()
    robot, file = SimulatedRobot(tmp_path, port), tmp_path / "controller.py"
    command = "holds" if cell.state == "holding" else "sways"
    goes_on = "stops" if cell.state == "stopping" else cell.given
    file.write_text(f"{CONTROLLER}\ncommand, goes_on = {command}, {goes_on}\n{EXTRA if goes_on == 'records' else ''}")
    link = ("--link", f"egm://127.0.0.1:{port}", "--log", str(tmp_path / "run"), "--seconds", str(PATIENCE))
    with robot.running():
        with program("-m", "armlab", "run", "yumi_right", str(file), *link) as first:
            report, said = first.communicate(timeout=2 * PATIENCE)
        with bridge.connect(f"egm://127.0.0.1:{port}", ROBOT, patience=PATIENCE) as second:
            again = second.run(sway, seconds=0.3)
    robot.judge()
    assert again.reason == "the time is up"
    is_whole(again.table)
    assert "Traceback" not in said
    assert first.returncode == 1, said + report
    assert cell.is_told(said), said
    [path] = tmp_path.glob("run*.mcap")
    told = log.inspect(path)
    assert told.finished
    table = log.read(path)
    is_whole(table, tuple(tick for begin, end, _ in told.summary["holes"] for tick in range(begin, end + 1)))
    assert table["session_t"][-1] > 0.3
    sent = table["qd_sent"][np.isfinite(table["qd_sent"]).all(axis=1)]
    assert (np.abs(sent).max() > 0.05) == (cell.state != "holding")
    assert not sent[-1].any(), "it came to rest"
