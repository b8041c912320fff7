"""Level 2 of the test ladder: nodes in Python, C (Cyclone DDS) and C++ (Fast DDS) that know nothing of armlab.

What stands here is what docs/ros.md says was checked, with the versions of Debian 12, on which .ci/run runs.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import kinematics, robots
from armlab.bridge.cell import parse_cell
from armlab.bridge.servers.hub import Hub
from armlab.bridge.servers.supervisor import Servers, server_command
from armlab.log import Tick
from armlab.state import Command, State

from .dds_peers import free_domain, until
from .ending import play

pytest.importorskip("cyclonedds", reason="the extra ros is not installed")

pytestmark = pytest.mark.slow

SOURCES = Path(__file__).parent / "peers"
ARM = robots.load("yumi_left")
PERIOD = 0.004
SETTLED = 2_000_000_000  # ns after the first sample, from which on none may be missing
SYSTEM = "/usr/bin:/bin:/usr/local/bin"  # the idlc of the wheel beside our Python makes code for another version


def _built(folder: Path, target: str, tools: tuple[str, ...], packages: str) -> list[str]:
    """Build a node where its tools are; the command that starts it."""
    missing = [tool for tool in tools if shutil.which(tool, path=SYSTEM) is None]
    if missing:
        pytest.skip(f"{', '.join(missing)} is missing: apt-get install {packages}")
    command = ["make", "-f", str(SOURCES / "Makefile"), target]
    environment = {**os.environ, "PATH": SYSTEM}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{done.stdout}{done.stderr}"
    return [str(folder / target)]


def _python(folder: Path) -> list[str]:
    return [sys.executable, str(SOURCES / "cyclone.py")]


def _cyclone(folder: Path) -> list[str]:
    return _built(folder, "cyclone", ("make", "gcc", "idlc"), "make gcc cyclonedds-dev cyclonedds-tools")


def _fast(folder: Path) -> list[str]:
    return _built(folder, "fast", ("make", "g++", "fastddsgen"), "make g++ libfastrtps-dev fastddsgen")


PEERS: dict[str, Callable[[Path], list[str]]] = {
    "cyclonedds, Python": _python,
    "Cyclone DDS 0.10.2, C": _cyclone,
    "Fast DDS 2.9.1, C++": _fast,
}


@pytest.fixture(scope="module", params=PEERS)
def node(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Command that starts a node of one kind; the same program was built once."""
    return PEERS[request.param](tmp_path_factory.mktemp("node"))


class Peer:
    """A running node: what it read is known when it has ended."""

    def __init__(
        self, command: list[str], folder: Path, domain: int, count: int, first: int, last: int, *more: str
    ) -> None:
        self.out, self.err = folder / f"{time.monotonic_ns()}.out", folder / f"{time.monotonic_ns()}.err"
        environment = {**os.environ, "CYCLONEDDS_URI": f"file://{SOURCES}/loopback.xml"}
        words = [*command, *map(str, (domain, count, first, last, *more))]
        with self.out.open("wb") as out, self.err.open("wb") as err:
            self.process = subprocess.Popen(words, stdout=out, stderr=err, env=environment)

    def is_reading(self) -> bool:
        return "reading" in self.err.read_text()

    def ended(self) -> dict[str, list[list[str]]]:
        """Wait for its end; the lines of each kind, in words."""
        assert self.process.wait(90.0) == 0, self.err.read_text()
        lines = [line.split() for line in self.out.read_text().splitlines()]
        return {kind: [words for words in lines if words[0] == kind] for kind in "JW"}


class Stream:
    """A loop that gives a row every 4 ms to the server, a process, and obeys its clients; in a thread."""

    def __init__(self) -> None:
        self.domain = free_domain()
        self.exchange = Hub([ARM], ["ros2"], allowed=["ros2"], about={"cell": "yumi"})
        options = {"domain": self.domain, "host": "127.0.0.1"}
        self.servers = Servers(self.exchange, {"ros2": server_command("ros2", options)})
        self.sent: dict[int, dict[str, np.ndarray]] = {}
        self.commands: list[np.ndarray] = []
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Stream:
        self.servers.__enter__()
        self.servers.ready()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()
        self.servers.close()

    def _run(self) -> None:
        rng, due = np.random.default_rng(3), time.monotonic()
        nothing = np.full(7, np.nan)
        while not self._over.is_set():
            q, wrench = ARM.q_home + 1e-3 * rng.standard_normal(7), rng.standard_normal(6)
            wall = time.time_ns()
            state = State(t=1.0, dt=PERIOD, q=q, qd=nothing, tau=nothing, robot=ARM.name, wrench=wrench)
            command = self.exchange.arbiter(state)
            if isinstance(command, Command) and command.qd is not None:
                self.commands.append(command.qd)
            k = len(self.sent)
            R = kinematics.forward(ARM, q)[:3, :3]
            self.sent[wall] = {"J": q, "W": np.concatenate([R.T @ wrench[:3], R.T @ wrench[3:]])}
            self.exchange.row(state, None, Tick(k, k, wall, 1_000, 2_000, 3))
            due = max(due, time.monotonic() - PERIOD) + PERIOD  # no burst makes up for what a busy machine took
            self._over.wait(max(0.0, due - time.monotonic()))

    def check(self, lines: list[list[str]], kind: str, is_whole: bool = True) -> None:
        """What came is what was sent, in order; from 2 s after the first nothing is missing."""
        stamps = [int(words[1]) for words in lines]
        assert stamps == sorted(set(stamps))
        for words, stamp in zip(lines, stamps, strict=True):
            numbers = np.array(words[4 : 11 if kind == "J" else 10], dtype=float)
            np.testing.assert_allclose(numbers, self.sent[stamp][kind], rtol=0, atol=1e-12)
        if is_whole:
            counted = [stamp for stamp in self.sent if stamps[0] + SETTLED <= stamp <= stamps[-1]]
            assert len(counted) > 1000
            assert len(set(counted) & set(stamps)) >= 0.999 * len(counted)


def test_a_node_reads_every_message_and_commands(node: list[str], tmp_path: Path) -> None:
    """Takes 10 s, besides building."""
    with Stream() as stream:
        lines = Peer(node, tmp_path, stream.domain, 1800, 1000, 1500).ended()
        assert stream.exchange.outlets["ros2"].lost == 0
    for kind in "JW":
        stream.check(lines[kind], kind)
    assert {words[3] for words in lines["J"]} == {"-"}
    assert {words[3] for words in lines["W"]} == {"yumi_left_tool"}
    assert {(words[11], words[12]) for words in lines["J"]} == {("yumi_robl_joint_3", "0")}
    assert len(stream.commands) > 100
    assert all(np.array_equal(qd, [0.05] * 7) for qd in stream.commands)
    assert any(client.startswith("ros2 ") for client in stream.exchange.arbiter.obeyed["yumi_left"])


def test_a_fast_dds_node_without_a_profile_finds_a_bridge_that_has_run_for_a_minute(tmp_path: Path) -> None:
    """The settings of `rmw_fastrtps_cpp`. A second node finds the bridge after the first has left. Takes 75 s."""
    command = _fast(tmp_path)
    with Stream() as stream:
        time.sleep(60.0)
        for _ in range(2):
            before = len(stream.commands)
            lines = Peer(command, tmp_path, stream.domain, 1000, 200, 700, "default").ended()
            assert len(lines["J"]) >= 1000
            assert len(stream.commands) > before + 100
            time.sleep(3.0)


def test_a_reader_that_stops_and_one_that_dies_disturb_nobody(node: list[str], tmp_path: Path) -> None:
    """Takes 20 s."""
    with Stream() as stream:
        slow, dead = (Peer(node, tmp_path, stream.domain, 2500, 0, 0) for _ in range(2))
        until(slow.is_reading)
        until(dead.is_reading)
        good = Peer([sys.executable, str(SOURCES / "cyclone.py")], tmp_path, stream.domain, 2000, 0, 0)
        until(good.is_reading)
        slow.process.send_signal(signal.SIGSTOP)
        dead.process.kill()
        dead.process.wait()
        lines = good.ended()  # 8 s: what waits for the two is not kept
        slow.process.send_signal(signal.SIGCONT)
        late = slow.ended()
        assert stream.exchange.outlets["ros2"].lost == 0
    stream.check(lines["J"], "J")
    stream.check(lines["W"], "W")
    delays = [int(words[2]) - int(words[1]) for words in lines["J"]]
    assert max(delays) < 1_000_000_000, "no message waited for a reader that does not read"
    stream.check(late["J"], "J", is_whole=False)
    assert max(np.diff([int(words[1]) for words in late["J"]])) > 2_000_000_000, "it did stop"


@pytest.fixture
def runtime(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return tmp_path  # type: ignore[return-value]


def test_a_node_moves_the_simulated_arm(node: list[str], runtime: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A whole cell in real time. Takes 8 s."""
    domain = free_domain()
    cell = parse_cell(
        f'name = "yumi"\ncommands = ["ros2"]\n[[robots]]\nname = "yumi_left"\nlink = "sim://yumi_left"\n'
        f"[servers.ros2]\ndomain = {domain}\n"
    )
    found: dict[str, Any] = {}
    run = play(monkeypatch, cell, lambda: found.update(Peer(node, runtime, domain, 1000, 300, 700).ended()))
    lines = found["J"]
    assert any(text.startswith("ros2 ") and text.endswith(" commands yumi_left.") for _, text in run.events)
    q = np.array([words[4:11] for words in lines], dtype=float)
    measured = {row.tobytes() for row in np.asarray(run.table["q"])}
    assert all(row.tobytes() in measured for row in q), "what the node read is what was measured"
    assert np.all(q[-1] - q[0] > 0.04)
    sent = run.table.dropna("qd_sent")["qd_sent"]
    assert np.nanmax(np.abs(sent)) <= 0.05 + 1e-9
