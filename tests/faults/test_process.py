"""Killed processes and exhausted memory: real processes, in real time."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from armlab import bridge, log
from armlab.errors import LinkError
from armlab.state import Command, State

from .bench import LONGEST, ROBOT, SimulatedRobot, free_port, is_whole, line, program, sway
from .matrix import Cell, shows

pytestmark = pytest.mark.slow


@shows
def test_a_simulator_is_killed(cell: Cell, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with bridge.connect("sim://yumi_right", ROBOT, patience=LONGEST) as link:
        process = link._simulator._process

        def controller(state: State) -> Command | None:
            if state.t < 0.2:
                return None if cell.state == "holding" else sway(state)
            process.kill()
            if cell.state == "stopping":
                return Command.stop()
            return None if cell.state == "holding" else sway(state)

        if cell.state == "waiting":
            process.kill()
        failure = None
        try:
            link.run(controller, record=path)
        except LinkError as error:
            failure = error
        assert (failure is None) == (cell.state == "stopping")
        told = f"{failure}\n" + "\n".join(text for _, text in link.last.events)
        assert cell.is_told(told), told
    assert log.inspect(path).finished
    table = log.read(path)
    is_whole(table)
    assert len(table) == link.last.statistics["packets"]
    with bridge.connect("sim://yumi_right?lockstep=true", ROBOT) as link:
        assert link.run(sway, seconds=0.1).reason == "the time is up"


BRIDGE = """
import os
import sys
from armlab import bridge, robots
from armlab.state import Command
import numpy as np
port, path, phase = sys.argv[1:]
told, sizes = [], set()
def controller(state):
    if state.t > 0.2:
        sizes.add(os.path.getsize(path))
    if len(sizes) > 10 and not told:
        told.append(print("now", flush=True))
        if phase == "stopping":
            return Command.stop()
    return None if phase == "holding" else Command(state.q_start + 0.1 * (1.0 - np.cos(4.0 * state.t)))
with bridge.connect(f"egm://127.0.0.1:{port}", robots.load("yumi_right")) as link:
    link.run(controller, record=path)
"""


@shows
def test_a_bridge_is_killed(cell: Cell, tmp_path: Path) -> None:
    port, path = free_port(), tmp_path / "run.mcap"
    robot = SimulatedRobot(tmp_path, port)
    with robot.running():
        with program("-c", BRIDGE, str(port), str(path), cell.state) as first:
            assert line(first.stdout) == "now\n", first.communicate()[1]
            before = robot.timeouts()
            first.kill()
            first.wait(LONGEST)
        robot.wait_for_timeout(before)
        with bridge.connect(f"egm://127.0.0.1:{port}", ROBOT, patience=LONGEST) as link:
            run = link.run(sway, seconds=0.3)
    assert run.reason == "the time is up"
    is_whole(run.table)
    assert cell.is_told("\n".join(robot.judge()))
    with pytest.warns(UserWarning, match="not finished"):
        table = log.read(path)
    is_whole(table)
    assert table["session_t"][-1] > 0.2, "all rows from before the writer's last ten writes are present"


SHOWN = 125  # cycles, half a second of robot time
READER = """
from armlab.bridge.servers.local import LocalFeed
from armlab.bridge.servers.messages import Subscribe
from armlab.bridge.servers.row import Row
from armlab.errors import LinkError
with LocalFeed() as feed:
    feed.ask(Subscribe(rate=None))
    numbers, holes = [], 0
    try:
        while True:
            message = feed.receive()
            if isinstance(message, Row):
                if not numbers:
                    print("row", flush=True)
                numbers.append(message.seq)
    except LinkError:
        print(len(numbers), numbers[-1] - numbers[0] + 1, flush=True)
"""


@shows
def test_a_view_is_killed(cell: Cell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("viser", reason="the view in the browser needs the extra `live`")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    calls, over = [0], threading.Event()
    with contextlib.ExitStack() as stack:
        link = stack.enter_context(bridge.connect("sim://yumi_right", ROBOT, offer="small", patience=LONGEST))

        def controller(state: State) -> Command | None:
            calls[0] += 1
            return Command.stop() if over.is_set() else None if cell.state == "holding" else sway(state)

        def watch() -> None:
            """Kill a view that shows the bridge, and let another one show it."""
            assert line(reader.stdout) == "row\n"
            end = time.monotonic() + 2 * LONGEST
            for _ in range(2):
                with program("-m", "armlab", "view", "--live", "--port", "0") as view:
                    assert line(view.stderr) == "Cell small\n"
                    enough = calls[0] + SHOWN
                    while calls[0] < enough and time.monotonic() < end:
                        time.sleep(0.01)
                    view.kill()
                    view.wait(LONGEST)
            over.set()

        watching = threading.Thread(target=watch, daemon=True)
        reader = stack.enter_context(program("-c", READER))
        watching.start()
        run = link.run(controller, record=tmp_path / "run.mcap", seconds=2 * LONGEST)
        watching.join(LONGEST)
        assert run.reason == "the controller ended the run"
        got, of = map(int, line(reader.stdout).split())
    assert got == of > 2 * SHOWN, "another client lost rows"
    served = run.statistics["servers"]["local"]
    assert served["lost"] == 0, "the loop could not pass on a row"
    assert sum(rows > 5 for rows, _ in served["clients"].values()) == 3, "both views and the reader saw the run"
    assert not any(dropped for _, dropped in served["clients"].values())
    is_whole(run.table)
    assert len(run.table) == run.statistics["packets"]
    assert log.inspect(tmp_path / "run.mcap").finished


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


@shows
@pytest.mark.skipif(sys.platform != "linux", reason="other kernels do not limit the address space of a process")
def test_no_memory_is_left(cell: Cell, tmp_path: Path) -> None:
    port = free_port()
    robot, file = SimulatedRobot(tmp_path, port), tmp_path / "controller.py"
    command = "holds" if cell.state == "holding" else "sways"
    goes_on = "stops" if cell.state == "stopping" else cell.given
    file.write_text(f"{CONTROLLER}\ncommand, goes_on = {command}, {goes_on}\n{EXTRA if goes_on == 'records' else ''}")
    link = ("--link", f"egm://127.0.0.1:{port}", "--log", str(tmp_path / "run"), "--seconds", str(LONGEST))
    with robot.running():
        with program("-m", "armlab", "run", "yumi_right", str(file), *link) as first:
            report, said = first.communicate(timeout=2 * LONGEST)
        with bridge.connect(f"egm://127.0.0.1:{port}", ROBOT, patience=LONGEST) as second:
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
