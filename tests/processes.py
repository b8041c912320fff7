"""Processes that tests start: routers, and bridges whose rows are made up; and how tests wait for what others do."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

PATIENCE = 20.0  # s; only a test that fails waits so long
PROGRAM = Path(__file__).with_name("publisher.py")


def until(condition: Callable[[], Any], patience: float = PATIENCE) -> None:
    """Wait for what another thread or process does."""
    end = time.monotonic() + patience
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.002)


def free_port() -> int:
    """Return a port on which nobody listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class Started:
    """A process of the test, which says a line when it is ready."""

    def __init__(self, *words: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, *words], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        assert self.process.stdout is not None
        self.first = self.process.stdout.readline()
        self.ready_ns = time.time_ns()  # by the clock of the rows' stamps

    def end(self) -> int:
        """Let it end by itself; return the rows that it published."""
        said, _ = self.process.communicate("", timeout=PATIENCE)
        return int(said.split()[-1])

    def kill(self) -> None:
        self.process.kill()
        self.process.communicate(timeout=PATIENCE)


@pytest.fixture
def processes() -> Iterator[Callable[..., Started]]:
    """Return what starts processes: `start("publisher", port, robots)`, `start("router", port)`."""
    made: list[Started] = []

    def begin(kind: str, port: int, *words: str) -> Started:
        made.append(Started(str(PROGRAM), kind, str(port), *words))
        return made[-1]

    yield begin
    for one in made:
        if one.process.poll() is None:
            one.kill()
