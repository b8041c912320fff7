"""Two commanders over two servers at one simulated arm for a minute, while whoever commands is killed at random."""

from __future__ import annotations

import itertools
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from armlab import log, robots
from armlab.bridge.cell import parse_cell, run_cell
from armlab.bridge.command.arbiter import LEASE, Arbiter
from armlab.bridge.control.limits import Limits
from armlab.bridge.servers.hub import Hub
from armlab.state import Command

from ..processes import free_port
from .beside import PATIENCE, WINDOW, Watch, more_missed
from .labcomm_client import SPEED as DOWN

pytest.importorskip("zenoh", reason="the extra net is not installed")

from .zenoh_client import SPEED as UP

pytestmark = pytest.mark.slow

TICKS = 15_000  # a minute, in real time, since the lease is
LEAST = 4  # deaths: a process takes seconds to start on a busy machine
MORE = 5  # ticks of a window, 20 ms: to end a process takes one of two cores for some
LEASE_NS = int(1e9 * LEASE)
CHANGE = re.compile(r"(.+?) (?:commands|(no longer commands)) yumi_left[.:]")
CELL = """
commands = ["zenoh", "labcomm"]
record = "{record}"
[[robots]]
name = "yumi_left"
link = "sim://yumi_left"
[servers.zenoh]
port = {zenoh}
[servers.labcomm]
ports = {{yumi_left = {labcomm}}}
parameters = 0
rows = 0
"""


class Obeyed(NamedTuple):
    """What the arbiter decided in a tick: when, of whom, how old the last command of that one was, and what."""

    ns: int
    client: str
    age_ns: int
    command: Command | None


class Bench:
    """Ports, the clients that were started, and what the bridge did and said."""

    def __init__(self) -> None:
        self.ports = {"zenoh": free_port(), "labcomm": free_port()}
        self.clients: list[subprocess.Popen[str]] = []
        self.letters = itertools.cycle("abcdefghijklmnopqrstuvwxyz")
        self.obeyed: list[Obeyed] = []
        self.told: list[str] = []
        self.refused: dict[str, int] = {}
        self.over = threading.Event()

    def client(self, server: str) -> subprocess.Popen[str]:
        """Start one that commands until it dies."""
        port = str(self.ports[server])
        words = ["zenoh_client.py", "zenoh", port, "command", next(self.letters)]
        if server == "labcomm":
            words = ["labcomm_client.py", port]
        path, pipe = Path(__file__).with_name(words[0]), subprocess.PIPE
        self.clients.append(subprocess.Popen([sys.executable, str(path), *words[1:]], stdout=pipe, text=True))
        return self.clients[-1]

    def told_why(self) -> list[str]:
        """End all clients; return what those over Zenoh were told."""
        said = []
        for one in self.clients:
            one.kill()
            said += one.communicate(timeout=PATIENCE)[0].splitlines()
        return said


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    made, obey, tell = Bench(), Arbiter.__call__, Hub.tell

    def obey_and_keep(arbiter: Arbiter, state: Any) -> Any:
        now = time.monotonic_ns()  # before the arbiter looks at the clock
        command = obey(arbiter, state)
        holder = arbiter._holders["yumi_left"]
        if holder is not None:
            made.obeyed.append(Obeyed(now, holder.client, now - holder.heard_ns, command))  # type: ignore[arg-type]
        else:
            made.obeyed.append(Obeyed(now, "", 0, command))  # type: ignore[arg-type]
        made.refused = {**arbiter.refused}
        return Command.stop() if made.over.is_set() else command

    def keep_and_tell(exchange: Hub, text: str, warn: bool = False, each: bool = False) -> None:
        made.told.append(text)
        tell(exchange, text, warn, each)

    monkeypatch.setattr(Arbiter, "__call__", obey_and_keep)
    monkeypatch.setattr(Hub, "tell", keep_and_tell)
    yield made
    made.told_why()


def play(bench: Bench, watch: Watch) -> list[int]:
    """Kill whoever commands, again and again; return the ticks of the deaths."""
    rng, deaths = np.random.default_rng(8), list[int]()
    alive = {server: bench.client(server) for server in bench.ports}

    def refused(server: str) -> int:
        return sum(count for client, count in bench.refused.items() if client.startswith(server))

    def commander() -> str:
        return watch["commander"].partition(" ")[0]

    def contested() -> tuple[str, str]:
        """Wait until both want the arm; return who has it and who is refused."""
        so_far, found = {server: refused(server) for server in alive}, list[tuple[str, str]]()

        def both_want_it() -> bool:
            pairs = (("zenoh", "labcomm"), ("labcomm", "zenoh"))
            holder = commander()
            found.extend(pair for pair in pairs if pair[0] == holder and refused(pair[1]) > so_far[pair[1]])
            return bool(found)

        watch.until(both_want_it)
        return found[-1]

    watch.until(lambda: commander() != "")
    while len(watch.ticks) < TICKS or len(deaths) < LEAST:
        holder, other = contested()
        watch.wait(WINDOW + int(rng.integers(100)))
        if commander() != holder:
            continue  # a client that was not run for the lease
        os.kill(alive[holder].pid, rng.choice([signal.SIGKILL, signal.SIGTERM, signal.SIGSTOP]))
        deaths.append(watch.ticks[-1])
        watch.until(lambda other=other: commander() == other)
        watch.wait(WINDOW)
        alive[holder].kill()  # what was stopped
        alive[holder] = bench.client(holder)
    return deaths


def run(bench: Bench, record: Path) -> tuple[Any, list[int]]:
    """Run the cell until the deaths are over; return the run, and the ticks of the deaths."""
    deaths: list[int] = []
    failures: list[BaseException] = []

    def script() -> None:
        try:
            deaths.extend(play(bench, Watch()))
        except BaseException as error:
            failures.append(error)
        bench.over.set()

    thread = threading.Thread(target=script, daemon=True)
    cell = parse_cell(CELL.format(record=record, **bench.ports))
    result = run_cell(cell, seconds=600.0, patience=PATIENCE, ready=lambda line: thread.start())
    thread.join(PATIENCE)
    if failures:
        raise failures[0]
    return result, deaths


def check_commands(obeyed: list[Obeyed]) -> None:
    """Each tick is one commander's, or hold; nobody commands who was silent for longer than the lease."""
    for one in obeyed:
        assert one.age_ns <= LEASE_NS, f"{one.client} was silent for {1e-9 * one.age_ns:.3f} s and commanded"
        if one.command is not None:
            assert one.command.qd is not None
            wanted = {"zenoh": UP, "labcomm": DOWN}[one.client.partition(" ")[0]]
            np.testing.assert_array_equal(one.command.qd, np.full(7, wanted))


def check_arm(table: log.Table) -> None:
    """It stayed within its limits, as it was told and as it was measured."""
    arm = robots.load("yumi_left")
    limits, sent = Limits.of(arm), table["qd_sent"]
    assert np.nanmax(np.abs(sent) / limits.qd_max) <= 1.0
    for name in ("q", "q_sent"):
        q = table[name]
        assert np.all((q >= arm.q_min) & (q <= arm.q_max) | np.isnan(q))
    seconds = 0.004 * np.diff(np.asarray(table["seq"], dtype=float))[:, None]
    assert np.nanmax(np.abs(np.diff(table["q_sent"], axis=0)) / (limits.qd_max * seconds)) <= 1.0 + 1e-9
    assert np.nanmax(np.abs(np.diff(sent, axis=0)) / (limits.qdd_max * seconds)) <= 1.0 + 1e-9


def check_changes(told: list[str]) -> set[str]:
    """Each takes a free arm and loses it before the next does; return who commanded."""
    holder, takers = "", set[str]()
    for found in filter(None, map(CHANGE.match, told)):
        if found[2]:
            assert holder == found[1]
            holder = ""
        else:
            assert holder == "", f"{found[1]} took the arm of {holder}"
            holder = found[1]
            takers.add(holder)
    return takers


def check_log(path: Path, told: list[str]) -> None:
    """Every change is in the log, by name."""
    logged = [event.text for event in log.inspect(path).events if CHANGE.match(event.text)]
    assert logged == [text for text in told if CHANGE.match(text)]


def test_one_commands_at_any_instant_whoever_dies(bench: Bench, tmp_path: Path) -> None:
    """By the log: who had the rights when; free within the lease; within limits; the loop misses no more. 70 s."""
    result, deaths = run(bench, tmp_path / "run.mcap")
    check_commands(bench.obeyed)
    check_arm(result.table)
    takers = check_changes(bench.told)
    assert {taker.partition(" ")[0] for taker in takers} == {"zenoh", "labcomm"}
    check_log(result.path, bench.told)
    assert any("yumi_left is commanded by labcomm" in text for text in bench.told_why())
    more = more_missed(result.table, deaths)
    assert np.median(more) <= MORE, f"packets missed more after than before each death: {more}"
