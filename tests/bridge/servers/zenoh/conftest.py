"""A Zenoh server at the other end of an exchange, and sessions that are closed after the test."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from armlab.bridge.inputs.parameters import Parameter, Parameters
from armlab.bridge.servers.hub import Hub
from armlab.bridge.servers.zenoh.process import ZenohProcess
from armlab.bridge.servers.zenoh.session import LabAddress, close_session
from armlab.log import Tick
from armlab.robots import Robot
from armlab.state import State

from ....processes import free_port, until

PATIENCE = 15.0  # s; only a test that fails waits so long


class Wire:
    """A way to a port that can be cut and mended."""

    def __init__(self, to: int) -> None:
        self.port, self._to, self._open = free_port(), to, list[socket.socket]()
        self.mend()

    def mend(self) -> None:
        listener = socket.create_server(("127.0.0.1", self.port))
        self._open = [listener]
        threading.Thread(target=self._accept, args=(listener, self._open), daemon=True).start()

    def cut(self) -> None:
        for one in list(self._open):
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
            one.close()

    def _accept(self, listener: socket.socket, ends: list[socket.socket]) -> None:
        with contextlib.suppress(OSError):
            while True:
                near, _ = listener.accept()
                with contextlib.suppress(OSError):
                    far = socket.create_connection(("127.0.0.1", self._to))
                    ends += [near, far]
                    for pair in ((near, far), (far, near)):
                        threading.Thread(target=self._carry, args=pair, daemon=True).start()
                    continue
                near.close()

    def _carry(self, near: socket.socket, far: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := near.recv(65536):
                far.sendall(data)
        for one in (near, far):
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)


class Running:
    """A Zenoh server in a thread, at the other end of an exchange."""

    def __init__(self, robot: Robot, port: int, **options: Any) -> None:
        declared = [Parameter("gain", 0.5, minimum=0.0, maximum=1.0, rights="anyone"), Parameter("n", 2, "int")]
        self.robot, self.exchange = robot, Hub([robot], ["zenoh"], Parameters(declared), ["zenoh"], about=ABOUT)
        self.options = {"lab": "lab1", "host": "127.0.0.1", "port": port, **options}
        self.feed = self.exchange.open("zenoh")
        self.process = ZenohProcess(self.feed, self.options)
        self.thread = threading.Thread(target=self.process.run)
        self.thread.start()
        self.tick = 0
        until(lambda: self.exchange.poll() or self.exchange.outlets["zenoh"].where)

    def state(self, **fields: Any) -> State:
        q = np.array(self.robot.q_home)
        nan = np.full(self.robot.n, np.nan)
        known = {
            "t": 0.004 * self.tick,
            "dt": 0.004,
            "q": q,
            "qd": np.zeros(self.robot.n),
            "tau": nan,
            "seq": self.tick,
        }
        return State(robot=self.robot.name, q_start=q, **{**known, **fields})

    def row(self, **fields: Any) -> State:
        """Let the loop send one row, and see what came back."""
        state = self.state(**fields)
        self.exchange.row(state, None, Tick(self.tick, -1, time.time_ns(), time.time_ns(), -1, 0))
        self.tick += 1
        return state

    def commanded(self) -> Any:
        """One tick of the loop: what the arbiter commands."""
        return self.exchange.arbiter(self.row())

    def close(self) -> None:
        self.exchange.close()
        self.thread.join(PATIENCE)
        assert not self.thread.is_alive()
        self.feed.close()


ABOUT = {"cell": "yumi", "commands": ["zenoh"]}


@pytest.fixture
def start(robot: Robot) -> Iterator[Callable[..., Running]]:
    """Return what starts servers."""
    made: list[Running] = []

    def begin(port: int = 0, **options: Any) -> Running:
        made.append(Running(options.pop("robot", robot), port or free_port(), **options))
        return made[-1]

    yield begin
    for one in made:
        one.close()


@pytest.fixture
def session() -> Iterator[Callable[..., Any]]:
    """Return what opens sessions to a server."""
    made: list[Any] = []

    def begin(port: int, **options: str) -> Any:
        made.append(LabAddress.of("127.0.0.1", port, options).open())
        return made[-1]

    yield begin
    for one in made:
        close_session(one)
