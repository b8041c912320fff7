"""Shared helpers of the server tests: waiting, and content that clients should not send."""

from __future__ import annotations

import contextlib
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.bridge.arbiter import Arbiter
from armlab.bridge.cell import Cell, parse_cell, run_cell
from armlab.bridge.inputs.parameters import Parameter, Parameters
from armlab.bridge.servers.hub import Hub
from armlab.bridge.servers.supervisor import Servers, server_command
from armlab.log import Tick
from armlab.robots import Robot
from armlab.state import Command, State

from ...processes import PATIENCE as PATIENCE
from ...processes import until as until

WALL = 1_700_000_000_000_000_000  # ns, stamp of the first row


class Served:
    """Server in a thread at one end of a hub; the loop sends rows of one arm and obeys clients."""

    def __init__(
        self,
        name: str,
        robot: Robot,
        make: Callable[[socket.socket], Any],
        parameters: Sequence[Parameter] = (),
        **options: Any,
    ) -> None:
        self.name, self.robot, self.tick = name, robot, 0
        about = {"cell": "yumi", "commands": [name]}
        options = {"allowed": [name], "about": about, **options}
        self.exchange = Hub([robot], [name], Parameters(parameters), **options)
        self.feed = self.exchange.open(name)
        self.server = make(self.feed)
        self.thread = threading.Thread(target=self.server.run)
        self.thread.start()
        self.where = until(
            lambda: self.exchange.poll() or self.exchange.outlets[name].where, what="the server listening"
        )

    def state(self, **fields: Any) -> State:
        q, nothing = np.array(self.robot.q_home), np.full(self.robot.n, np.nan)
        given = {"t": 0.004 * self.tick, "q": q, "qd": 0.0 * q, "tau": nothing, "seq": self.tick, **fields}
        return State(dt=0.004, robot=self.robot.name, q_start=q, **given)

    def row(self, **fields: Any) -> State:
        state, stamp = self.state(**fields), WALL + 4_000_000 * self.tick
        self.exchange.row(state, None, Tick(self.tick, -1, stamp, time.time_ns(), -1, 0))
        self.tick += 1
        return state

    def commanded(self, **fields: Any) -> Command | None:
        command = self.exchange.arbiter(self.row(**fields))
        assert not isinstance(command, tuple)
        return command

    def close(self) -> None:
        self.exchange.close()
        self.thread.join(PATIENCE)
        assert not self.thread.is_alive()
        self.feed.close()


class ServedProcess:
    """Server process at one end of a hub; the stamp of each row of the right arm is its number."""

    def __init__(
        self, stack: contextlib.ExitStack, name: str, options: Mapping[str, Any], restarts: Sequence[float] = ()
    ) -> None:
        self.robot, self.stack, self.number = robots.load("yumi_right"), stack, 0
        parameters = Parameters([Parameter("gain", 0.5, minimum=0.0, maximum=1.0)])
        self.exchange = Hub([self.robot], [name], parameters, [name], about={"cell": "yumi"})
        self.servers = stack.enter_context(Servers(self.exchange, {name: server_command(name, options)}, restarts))
        (self.where,) = self.servers.ready(60.0)

    def state(self) -> State:
        q = np.array(self.robot.q_home)
        return State(t=1.5, dt=0.004, q=q, qd=np.zeros(7), tau=q, robot=self.robot.name, q_start=q)

    def row(self) -> None:
        self.number += 1
        self.exchange.row(self.state(), None, Tick(self.number, -1, self.number, 0, -1, 0))


def nested(depth: int) -> list[Any]:
    found: list[Any] = []
    for _ in range(depth):
        found = [found]
    return found


def cell_of(server: str, settings: str = "", arm: str = 'link = "sim://yumi_left"') -> Cell:
    """Return a cell with one simulated arm and one server that may command."""
    robot = f'[[robots]]\nname = "yumi_left"\n{arm}\n'
    return parse_cell(f'name = "yumi"\ncommands = ["{server}"]\n{robot}[servers.{server}]\n{settings}\n')


LONGEST = 120.0  # s; reached only if a test fails


def play(monkeypatch: pytest.MonkeyPatch, cell: Cell, script: Callable[[], None]) -> Any:
    """Run a cell in this thread and a script of its clients in another; when one ends, the other ends as well."""
    over, obey, failures = threading.Event(), Arbiter.__call__, list[BaseException]()

    def obey_or_end(arbiter: Arbiter, state: State) -> Any:
        command = obey(arbiter, state)
        return Command.stop() if over.is_set() else command

    def run() -> None:
        try:
            script()
        except BaseException as error:
            failures.append(error)
        over.set()

    monkeypatch.setattr(Arbiter, "__call__", obey_or_end)
    thread = threading.Thread(target=run, daemon=True)
    with tempfile.TemporaryDirectory() as folder:
        monkeypatch.setenv("XDG_RUNTIME_DIR", folder)
        try:
            return run_cell(cell, seconds=LONGEST, patience=20.0, ready=lambda line: thread.start())
        finally:
            thread.join(LONGEST)
            assert not thread.is_alive()
            if failures:
                raise failures[0]
