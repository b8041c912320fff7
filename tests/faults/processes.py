"""Real processes in real time: programs of ours, a simulated robot that tells what it saw, what its log must be."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np

from armlab import bridge
from armlab.bridge.control.limits import Limits
from armlab.log import Table
from armlab.state import Command, State

from .bench import PERIOD, ROBOT

__all__ = ["PATIENCE", "SimulatedRobot", "free_port", "is_whole", "line", "program", "sway"]

PATIENCE = 30.0  # s; only a test that fails waits so long
LIMITS = Limits.of(ROBOT)
NO_DATA = "41822 No data from the UdpUc device"
REST = 0.01  # rad/s, of the true arm; its reference stands still


def sway(state: State) -> Command:
    return Command(state.q_start + 0.1 * (1.0 - np.cos(4.0 * state.t)))


def is_whole(table: Table, lost: tuple[int, ...] = ()) -> None:
    """Rows without a hole, but for the ticks that are said to be lost; references without a jump.

    A packet that was overtaken has no reference.
    """
    if not len(table):
        return
    ticks = [tick for tick in range(len(table) + len(lost)) if tick not in lost]
    np.testing.assert_array_equal(table["tick"], ticks)
    step = 1.5 * max(PERIOD, table["dt"].max())  # on a busy machine the simulated robot leaves cycles out
    for session in np.unique(table["session"]):
        sent = table["q_sent"][table["session"] == session]
        sent = sent[np.isfinite(sent).all(axis=1)]
        assert (np.abs(np.diff(sent, axis=0)) <= LIMITS.qd_max * step).all()
        assert ((sent >= LIMITS.q_min) & (sent <= LIMITS.q_max)).all()


@contextlib.contextmanager
def program(*words: str, errors: IO[str] | int = subprocess.PIPE) -> Iterator[subprocess.Popen[str]]:
    """A program of ours, ended with the test."""
    process = subprocess.Popen([sys.executable, *words], stdout=subprocess.PIPE, stderr=errors, text=True)
    try:
        yield process
    finally:
        process.kill()
        process.communicate(timeout=PATIENCE)


def line(file: IO[str] | None) -> str:
    return file.readline()


def free_port() -> int:
    port = bridge.connect("egm://127.0.0.1:0", ROBOT)
    port.close()
    return port.port


class SimulatedRobot:
    """`armlab sim` as a process: what it says while it runs, and what it counted and knew when it has ended.

    Parameters
    ----------
    folder : for its files. port : where it sends.
    """

    def __init__(self, folder: Path, port: int) -> None:
        self._said, self._stats, self._truth = (folder / name for name in ("said.txt", "stats.json", "truth.csv"))
        files = ("--stats", str(self._stats), "--truth", str(self._truth))
        self._words = ("sim", "yumi_right", "--to", f"127.0.0.1:{port}", "--extension", "--comm-timeout", "0.2", *files)
        self._process: Any = None

    @contextlib.contextmanager
    def running(self) -> Iterator[None]:
        with self._said.open("w") as said, program("-m", "armlab", *self._words, errors=said) as self._process:
            yield
            self._process.terminate()
            self._process.wait(PATIENCE)

    def timeouts(self) -> int:
        """Return how many time-outs it has told so far; what it says is in the file before its next packet."""
        return self._said.read_text().count(NO_DATA)

    def wait_for_timeout(self, before: int) -> None:
        """Wait until it has told one more."""
        end = time.monotonic() + PATIENCE
        while self.timeouts() == before:
            assert time.monotonic() < end, self._said.read_text()
            time.sleep(0.01)

    def judge(self) -> list[str]:
        """Its arm stayed within the limits, and stood at the beginning of each session. Return its events."""
        [counted] = json.loads(self._stats.read_text()).values()
        events = [f"{event['number']} {event['text']}" for event in counted["events"]]
        assert not any("out of bounds" in event for event in events), events
        head, *rows = self._truth.read_text().splitlines()
        names, truth = head.split(","), np.loadtxt(rows, delimiter=",")
        q, qd = (truth[:, [names.index(f"{name}{i + 1} [{unit}]") for i in range(ROBOT.n)]] for name, unit in _COLUMNS)
        assert ((q >= ROBOT.q_min) & (q <= ROBOT.q_max)).all(), "the arm left its limits"
        assert (np.abs(qd) <= ROBOT.qd_max).all(), "the arm was too fast"
        begins = np.flatnonzero(np.diff(truth[:, names.index("session")])) + 1
        assert np.abs(qd[begins]).max(initial=0.0) < REST, "the arm did not stop"
        return events


_COLUMNS = (("q", "rad"), ("qd", "rad/s"))
