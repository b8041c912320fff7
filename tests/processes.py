"""Processes started by tests: routers, and bridges with synthetic rows; and helpers that wait for other processes."""

from __future__ import annotations

import contextlib
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pytest

PATIENCE = 20.0  # s; only a test that fails waits so long
RWS_USER, RWS_PASSWORD = "operator", "kept-from-every-text-91"
PROGRAM = Path(__file__).with_name("publisher.py")


def until(condition: Callable[[], Any], patience: float = PATIENCE, what: str = "it") -> Any:
    """Wait until another thread or process makes a condition true, and return its value."""
    end = time.monotonic() + patience
    while not (found := condition()):
        assert time.monotonic() < end, f"{what} did not happen"
        time.sleep(0.001)
    return found


def free_port() -> int:
    """Return an unused port."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def bound(process: int, but: int = -1) -> set[str]:
    """Return the addresses on which a process and its descendants listen, from /proc, except those of process `but`."""
    parents = {}
    for folder in Path("/proc").iterdir():
        with contextlib.suppress(OSError, ValueError, IndexError):
            parents[int(folder.name)] = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
    family, inodes = {process}, set()
    for _ in range(5):
        family |= {child for child, parent in parents.items() if parent in family}
    for one in family - {but}:
        with contextlib.suppress(OSError):
            inodes |= {str(entry.readlink()) for entry in Path(f"/proc/{one}/fd").iterdir()}
    found = set()
    for table in ("tcp", "tcp6", "udp", "udp6"):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            words = line.split()
            if f"socket:[{words[9]}]" in inodes and words[3] in ("0A", "07"):  # listening; bound UDP
                address = words[1].partition(":")[0]
                found.add(socket.inet_ntoa(bytes.fromhex(address)[::-1]) if len(address) == 8 else address)
    return found


class Started:
    """A process started by a test, which prints a line when it is ready."""

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
    """Return a function that starts processes: `start("publisher", port, robots)`, `start("router", port)`."""
    made: list[Started] = []

    def begin(kind: str, port: int, *words: str) -> Started:
        made.append(Started(str(PROGRAM), kind, str(port), *words))
        return made[-1]

    yield begin
    for one in made:
        if one.process.poll() is None:
            one.kill()


class RwsController(NamedTuple):
    """A virtual ABB controller that answers Robot Web Services: its state, address, url and certificate."""

    box: Any
    host: str
    url: str
    ca: Path | None


@contextlib.contextmanager
def rws_controller(
    folder: Path, robotware: str = "6.10", faults: Sequence[str] = (), robots: Sequence[str] = ("yumi_left",)
) -> Iterator[RwsController]:
    """Serve a virtual controller; its user and password are `RWS_USER` and `RWS_PASSWORD`."""
    from armlab.cli.bridge import self_signed
    from armlab.sim.controller.rws import RwsServer, VirtualController

    box = VirtualController(robots, [("127.0.0.1", 6511 + k) for k in range(len(robots))], robotware, faults)
    tls = self_signed(folder) if box.is_rws2 else None
    server = RwsServer(box, 0, RWS_USER, RWS_PASSWORD, tls)
    host = f"127.0.0.1:{server.port}"
    try:
        yield RwsController(box, host, f"http{'s' if tls else ''}://{host}", folder / "self.pem" if tls else None)
    finally:
        server.close()
