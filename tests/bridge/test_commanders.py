"""Whole cells with a simulated robot in real time whose clients are killed, or stopped by a signal."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab.bridge.arbiter import LEASE, Arbiter
from armlab.bridge.cell import parse_cell, run_cell
from armlab.bridge.servers.hub import Hub
from armlab.bridge.servers.local import LocalFeed
from armlab.bridge.servers.messages import Subscribe
from armlab.bridge.servers.row import Row
from armlab.errors import LinkError
from armlab.log import Table
from armlab.state import Command

from ..processes import free_port, until

pytest.importorskip("zenoh", reason="the extra net is not installed")

from .zenoh_client import SPEED as UP

PATIENCE = 60.0  # s; only a test that fails waits so long
WINDOW = 100  # ticks before and after what happened, in which packets without an answer are compared


class Watch:
    """A reader of another server, which must get every row; it reads in a thread of its own."""

    def __init__(self) -> None:
        self.ticks: list[int] = []
        self.row: Row | None = None
        self.thread = threading.Thread(target=self._read, daemon=True)
        self.thread.start()

    def _read(self) -> None:
        with LocalFeed() as feed, contextlib.suppress(LinkError):  # the bridge ends
            feed.ask(Subscribe(rate=None))
            while True:
                message = feed.receive()
                if isinstance(message, Row):
                    self.row = message
                    self.ticks.append(message.values["yumi_left.tick"])

    def __getitem__(self, name: str) -> Any:
        """A value of the newest row."""
        return self.row.values[f"yumi_left.{name}"]

    def until(self, condition: Callable[[], bool]) -> None:
        until(lambda: self.row is not None and condition(), PATIENCE)

    def wait(self, ticks: int) -> None:
        """Wait for so many rows from now on."""
        last = len(self.ticks) + ticks
        self.until(lambda: len(self.ticks) > last)

    def commands(self, who: str) -> bool:
        return self["commander"] == who

    def check(self) -> None:
        """It got every row, in order."""
        steps = np.diff(self.ticks)
        assert steps.min() == 1
        assert np.sum(steps - 1) <= 0.001 * len(self.ticks)


def more_missed(table: Table, ticks: Sequence[int], window: int = WINDOW) -> list[int]:
    """Return how many more packets were missed in a window after each tick than in one before.

    Packets that were lost have no row, and those that were overtaken no answer. While the loop stands still in the
    controller, as the arbiter is, its guard answers that the arm holds: late.
    """
    number, seq = (np.asarray(table[name], dtype=int) for name in ("tick", "seq"))
    in_time = (np.asarray(table["send_ns"]) > 0) & (np.asarray(table["late"]) == 0)
    missed = np.diff(seq, prepend=seq[0] - 1) - in_time
    places = [int(np.searchsorted(number, tick)) for tick in ticks]
    return [int(missed[at : at + window].sum() - missed[at - window : at].sum()) for at in places]


pytestmark = pytest.mark.slow
PROGRAM = Path(__file__).with_name("zenoh_client.py")
MOST_MISSED = 20  # packets, 0.08 s: a busy machine misses some; a loop that is held up has more
LEASE_NS = int(1e9 * LEASE)
STOPPED = 2500  # ticks that a reader stands still: more than its buffers hold
BEFORE = 500  # ticks before that, in which packets without an answer are counted, and as many of it
CELL = """
commands = ["{dialect}"]
[[robots]]
name = "yumi_left"
link = "sim://yumi_left"
[servers.{dialect}]
port = {port}
"""


class Bench:
    """A cell and its clients; the run ends when the script has."""

    def __init__(self, dialect: str) -> None:
        self.dialect, self.port, self.over = dialect, free_port(), threading.Event()
        self.clients: list[subprocess.Popen[str]] = []
        self.told: list[str] = []
        self.oldest = 0  # ns: the longest silence after which a client still commanded

    def client(self, role: str, letter: str = "r") -> subprocess.Popen[str]:
        words = [sys.executable, str(PROGRAM), self.dialect, str(self.port), role, letter]
        self.clients.append(subprocess.Popen(words, stdout=subprocess.PIPE, text=True))
        return self.clients[-1]

    def name(self, letter: str) -> str:
        """Who the arbiter says that this is."""
        return f"{self.dialect} {16 * letter.encode().hex()}"

    def run(self, script: Callable[[Watch], None]) -> Any:
        """Play the script beside the cell."""
        failures: list[BaseException] = []

        def play() -> None:
            try:
                script(Watch())
            except BaseException as error:
                failures.append(error)
            self.over.set()

        thread = threading.Thread(target=play, daemon=True)
        cell = parse_cell(CELL.format(dialect=self.dialect, port=self.port))
        try:
            return run_cell(cell, seconds=300.0, patience=PATIENCE, ready=lambda line: thread.start())
        finally:
            thread.join(PATIENCE)
            assert not thread.is_alive()
            if failures:
                raise failures[0]

    def close(self) -> None:
        for one in self.clients:
            with contextlib.suppress(ProcessLookupError):
                os.kill(one.pid, signal.SIGCONT)
            one.kill()
            one.wait()
            one.stdout.close()


class Missing:
    """What a reader says that it missed: numbers left out, and numbers that came back, by key."""

    def __init__(self, lines: Iterable[str]) -> None:
        self.lost, self.back = Counter[str](), Counter[str]()
        for kind, count, name in map(str.split, lines):
            {"gap": self.lost, "back": self.back}[kind][name] += int(count)


@pytest.fixture(params=["zenoh", "rmw_zenoh"])
def bench(request: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    if request.param == "rmw_zenoh":
        pytest.importorskip("xxhash", reason="the extra net is not installed")
        monkeypatch.setenv("ROS_DOMAIN_ID", "0")
    made = Bench(request.param)
    obey = Arbiter.__call__

    def obey_or_end(arbiter: Arbiter, state: Any) -> Any:
        now = time.monotonic_ns()  # before the arbiter looks at the clock
        command = obey(arbiter, state)
        holder = arbiter._holders["yumi_left"]
        if holder is not None:
            made.oldest = max(made.oldest, now - holder.heard_ns)
        return Command.stop() if made.over.is_set() else command

    tell = Hub.tell

    def keep_and_tell(exchange: Hub, text: str, warn: bool = False, each: bool = False) -> None:
        made.told.append(text)
        tell(exchange, text, warn, each)

    monkeypatch.setattr(Arbiter, "__call__", obey_or_end)
    monkeypatch.setattr(Hub, "tell", keep_and_tell)
    yield made
    made.close()


def test_a_commander_that_dies_or_stands_still_loses_the_arm_and_another_takes_it(bench: Bench) -> None:
    """What is killed says nothing, and what is stopped is half open: it is the lease that ends both. Takes 10 s.

    By the clock of the arbiter, in each tick: the first tick after the lease frees the arm, however late it comes.
    """

    def script(watch: Watch) -> None:
        for letter, sign in (("a", signal.SIGKILL), ("b", signal.SIGSTOP)):
            one = bench.client("command", letter)
            watch.until(lambda letter=letter: watch.commands(bench.name(letter)) and watch["qd_sent"][0] > 0.5 * UP)
            watch.wait(WINDOW)
            ends.append(watch.ticks[-1])
            os.kill(one.pid, sign)
            watch.until(lambda: watch.commands(""))
            watch.until(lambda: np.abs(watch["qd_sent"]).max() < 1e-9)
        bench.client("command", "c")
        watch.until(lambda: watch.commands(bench.name("c")))
        os.kill(one.pid, signal.SIGCONT)  # it goes on where it was, and asks like any other
        watch.wait(250)
        watch.check()

    ends: list[int] = []
    run = bench.run(script)
    assert 0 < bench.oldest <= LEASE_NS
    changes = [text for text in bench.told if " commands yumi_left." in text or " no longer commands yumi_left" in text]
    takers = []
    for taken, lost in zip(changes[::2], [*changes[1::2], ""], strict=False):
        takers.append(taken.removesuffix(" commands yumi_left."))
        assert lost in ("", f"{takers[-1]} no longer commands yumi_left: silent for 0.1 s. The arm holds.")
    assert set(takers) == {bench.name(letter) for letter in "abc"}
    # Both ask from then on: on a busy machine c may have been silent for a lease, and b have it again.
    refused = [f"A command of {bench.name(letter)} was refused: yumi_left is" for letter in "bc"]
    assert any(text.startswith(tuple(refused)) for text in bench.told)
    assert np.nanmax(np.abs(run.table["qd_sent"])) <= UP * (1.0 + 1e-9), "no jump at a takeover"
    more = more_missed(run.table, ends)
    assert max(more) <= MOST_MISSED, f"packets missed more after than before each end: {more}"


def test_a_reader_that_stands_still_disturbs_nobody_and_sees_what_it_missed(bench: Bench) -> None:
    """It reads every key and is stopped for longer than its buffers last; Zenoh tells nobody else. Takes 15 s."""

    def script(watch: Watch) -> None:
        slow, other = bench.client("read"), bench.client("read")
        for one in (slow, other):
            assert one.stdout.readline() == "row\n"
        watch.wait(BEFORE)
        stops.append(watch.ticks[-1])
        os.kill(slow.pid, signal.SIGSTOP)
        watch.wait(STOPPED)
        os.kill(slow.pid, signal.SIGCONT)
        heard: list[str] = []
        reader = threading.Thread(target=lambda: heard.append(slow.stdout.readline()), daemon=True)
        reader.start()
        watch.until(lambda: bool(heard))
        missing = Missing(heard)
        assert 0 < max(missing.lost.values()) <= watch.ticks[-1] - stops[0] + WINDOW
        assert not missing.back
        watch.check()
        other.kill()
        assert other.stdout is not None
        missing = Missing(other.stdout)
        assert not missing.back
        assert max(missing.lost.values(), default=0) <= 0.001 * STOPPED, f"the other lost {missing.lost}"

    stops: list[int] = []
    run = bench.run(script)
    (more,) = more_missed(run.table, stops, BEFORE)
    assert more <= MOST_MISSED, f"packets missed more while a reader stood still: {more}"
    assert run.reason == "the controller ended the run"
