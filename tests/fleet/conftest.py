"""A router, bridges whose rows are made up, each in a process of its own, and logs of the short arm in a folder."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from armlab import log, robots
from armlab.robots import Robot

PATIENCE = 20.0  # s; only a test that fails waits so long
PROGRAM = Path(__file__).with_name("publisher.py")


def until(condition: Callable[[], Any], patience: float = PATIENCE) -> None:
    """Wait for what another thread or process does."""
    end = time.monotonic() + patience
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.005)


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

    def end(self) -> int:
        """Let it end by itself; return the rows that it published."""
        said, _ = self.process.communicate("", timeout=PATIENCE)
        return int(said.split()[-1])

    def kill(self) -> None:
        self.process.kill()
        self.process.communicate(timeout=PATIENCE)


@pytest.fixture(scope="session")
def robot() -> Robot:
    return robots.load("yumi_right")


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


@pytest.fixture(scope="session")
def folder(short_arm, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six logs of 10 s."""
    folder = tmp_path_factory.mktemp("logs")
    for k in range(6):
        log.write(short_arm.log(k, 1000), folder / f"log{k}.parquet")
    return folder


@pytest.fixture
def early(monkeypatch: pytest.MonkeyPatch) -> None:
    """A draft of the first two of these, so that the others are new to it."""
    monkeypatch.setattr("armlab.fleet.identification.DRAFT_SECONDS", 15.0)
