"""`armlab run` while every core is busy: between two replies never more than the allowed speed."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from armlab import log, robots

CONTROLLER = """
import numpy as np
from armlab.state import Command
def fast(state):
    return Command(qd=3.0 * np.cos(3.0 * state.t) * np.ones(7))
"""


@pytest.fixture
def busy() -> Iterator[None]:
    spinning = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(os.cpu_count() or 1)]
    yield
    for one in spinning:
        one.kill()
        one.wait()


@pytest.mark.slow
@pytest.mark.usefixtures("busy")
def test_no_run_on_a_busy_computer_is_faster_than_allowed(tmp_path: Path) -> None:
    robot, file = robots.load("yumi_right"), tmp_path / "fast.py"
    file.write_text(CONTROLLER)
    for k in range(5):
        folder = tmp_path / str(k)
        folder.mkdir()
        command = f"run yumi_right {file}:fast --seconds 1.5 --speed 0.5 --log {folder}/"
        subprocess.run([sys.executable, "-m", "armlab", *command.split()], check=True, capture_output=True, timeout=120)
        (path,) = folder.glob("*.mcap")
        table = log.read(path)
        went = np.isfinite(table["q_sent"]).all(axis=1)
        q, qd, dt = table["q_sent"][went], table["qd_sent"][went], 1e-9 * np.diff(table["robot_ns"][went])
        moving = qd[1:].any(axis=1)
        assert moving.sum() > 50
        speed = np.abs(np.diff(q, axis=0) / dt[:, None])[moving]
        assert (speed <= 0.5 * robot.qd_max * (1.0 + 1e-9)).all()
