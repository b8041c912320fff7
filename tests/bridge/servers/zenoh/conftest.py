"""A Zenoh server at the other end of a hub, and sessions that are closed after the test."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from armlab.bridge.inputs.parameters import Parameter
from armlab.bridge.servers.zenoh.process import ZenohProcess
from armlab.bridge.servers.zenoh.session import LabAddress, _open, close_session
from armlab.robots import Robot

from ....processes import free_port
from ..conftest import Served


class Wire:
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


class Running(Served):
    def __init__(self, robot: Robot, port: int, **options: Any) -> None:
        declared = [Parameter("gain", 0.5, minimum=0.0, maximum=1.0, rights="anyone"), Parameter("n", 2, "int")]
        self.options = {"lab": "lab1", "host": "127.0.0.1", "port": port, **options}
        super().__init__("zenoh", robot, lambda feed: ZenohProcess(feed, self.options), declared)


def heard(session: Any, name: str) -> list[Any]:
    samples: list[Any] = []
    session.declare_subscriber(name, lambda sample: samples.append(sample))
    return samples


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("armlab.bridge.servers.zenoh.feed._DISCOVERY", 0.1)


@pytest.fixture
def start(robot: Robot) -> Iterator[Callable[..., Running]]:
    with contextlib.ExitStack() as stack:

        def begin(port: int = 0, **options: Any) -> Running:
            one = Running(options.pop("robot", robot), port or free_port(), **options)
            return stack.enter_context(contextlib.closing(one))

        yield begin


@pytest.fixture(autouse=True)
def closed() -> Iterator[None]:
    yield
    for one in list(_open):
        close_session(one)


@pytest.fixture
def session() -> Callable[..., Any]:
    return lambda port, **options: LabAddress.of("127.0.0.1", port, options).open()
