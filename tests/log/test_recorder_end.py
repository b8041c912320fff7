"""However the process of a recorder ends but by signal 9, its file is whole."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

from armlab.log import Recorder, inspect, read
from armlab.robots import Robot


def test_closing_twice_and_rows_after_closing(tmp_path: Path, robot: Robot, rows: Callable) -> None:
    recorder = Recorder(tmp_path / "run.mcap", robot)
    recorder.row(*rows(0))
    recorder.event("hello", 5)
    recorder.close({"late": 3, "p99": np.float64(1.5), "bins": np.arange(2)})
    recorder.close()
    assert not recorder.row(*rows(1))
    held = inspect(recorder.path)
    assert held.summary == {"late": 3, "p99": 1.5, "bins": [0, 1], "rows": 1, "dropped": 0, "holes": []}
    assert (held.events[-1].text, held.events[-1].stamp_ns) == ("hello", 5)


INTERRUPTED = """
import time
import numpy as np
from armlab import robots
from armlab.log import Recorder, Tick
from armlab.state import State
robot = robots.load("yumi_right")
x = np.zeros(7)
try:
    with Recorder({path!r}, robot) as recorder:
        i = 0
        while True:
            recorder.row(State(i * 0.004, 0.004, x, x, x, robot_ns=1 + i), None, Tick(i, i, 10**18 + i, 1, 1, 0))
            i += 1
            if i == 300:
                print("ready", flush=True)
            time.sleep(0.001)
except KeyboardInterrupt:
    print(i, flush=True)
"""


def test_ctrl_c_leaves_a_complete_file(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    code = INTERRUPTED.format(path=str(path))
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == "ready\n"
        child.send_signal(signal.SIGINT)
        rows = int(child.stdout.readline())
        assert child.wait(20) == 0
    assert inspect(path).finished
    assert abs(len(read(path)) - rows) <= 1  # the row in progress when the signal came


def test_a_recorder_that_nobody_closes_is_closed_at_exit(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    code = INTERRUPTED.format(path=str(path)).replace("while True", "while i < 300")
    code = code.replace(
        f"with Recorder({str(path)!r}, robot) as recorder", f"if recorder := Recorder({str(path)!r}, robot)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
    assert inspect(path).finished
    assert len(read(path)) == 300
