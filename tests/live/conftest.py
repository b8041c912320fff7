"""One server for all tests without a browser, each of which starts with an empty scene and panel; and bridges to
view."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from armlab import live
from armlab.bridge.servers.hub import OPERATOR, Hub
from armlab.bridge.servers.local import LocalServer, socket_path
from armlab.live.live_bridge import Running
from armlab.live.server import HOST
from armlab.log import Tick
from armlab.robots import Robot
from armlab.state import Command, State

from .fleet_bridges import fleet as fleet

LOOKS = 200  # each at most 0.1 s; only a failing test uses all of them


@pytest.fixture(scope="session")
def _server() -> Iterator[Any]:
    pytest.importorskip("viser", reason="the view in the browser needs the extra `live`")
    server = live.start(0)
    yield server
    live.stop(server)


@pytest.fixture
def server(_server: Any) -> Any:
    _server.scene.reset()
    _server.gui.reset()
    return _server


@pytest.fixture
def page() -> Callable[..., Any]:
    """Return a function that connects to a server like its page, without a browser, with a given origin."""
    viser = pytest.importorskip("viser", reason="the view in the browser needs the extra `live`")
    import msgspec
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import connect
    from websockets.typing import Origin, Subprotocol

    version = Subprotocol(f"viser-v{viser.__version__}")
    camera = {"wxyz": (1.0, 0.0, 0.0, 0.0), "position": (2.0, 1.0, 1.0), "fov": 0.8, "near": 0.01, "far": 1000.0}
    ways = {"look_at": (0.0, 0.0, 0.0), "up_direction": (0.0, 0.0, 1.0), "image_height": 600, "image_width": 800}

    def open_(port: int, origin: str | None = None) -> Any:
        said = None if origin is None else Origin(origin)
        socket = connect(f"ws://{HOST}:{port}", subprotocols=[version], origin=said, max_size=None, proxy=None)
        with contextlib.suppress(ConnectionClosed):  # the next receive reports it
            socket.send(msgspec.msgpack.encode({"type": "ViewerCameraMessage", **camera, **ways}))
        return socket

    return open_


class Bridge:
    def __init__(self, arms: list[Robot], cell: str = "small") -> None:
        self._exchange = Hub(arms, [OPERATOR], about={"cell": cell})
        self._far = self._exchange.open(OPERATOR)
        self._server = threading.Thread(target=LocalServer(self._far, {"path": socket_path(cell)}).run, daemon=True)
        self._server.start()
        self._ticks = 0

    def row(self, arm: Robot, record: dict[str, Any] | None = None, later: float = 0.0, **fields: Any) -> None:
        """Send a row with a stamp `later` seconds from now."""
        self._ticks += 1
        state = State(**{"t": 0.0, "dt": 0.004, "q": arm.q_home, "qd": 0 * arm.q_home, "tau": 0 * arm.q_home, **fields})
        command = None if record is None else Command(record=record)
        now = time.time_ns() + int(1e9 * later)
        self._exchange.row(replace(state, robot=arm.name), command, Tick(self._ticks, 0, now, now, now, 0))

    def say(self, sentence: str) -> None:
        self._exchange.event(sentence)

    def close(self) -> None:
        self._exchange.close()
        self._server.join(10.0)
        assert not self._server.is_alive()
        self._far.close()


@pytest.fixture
def bridge(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Bridge]]:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with contextlib.ExitStack() as stack:
        yield lambda *arms, **options: stack.enter_context(contextlib.closing(Bridge(list(arms), **options)))


@pytest.fixture
def following(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Running]]:
    monkeypatch.setattr("armlab.live.live_bridge._AGAIN", 0.05)
    with contextlib.ExitStack() as stack:
        yield lambda *words, **options: stack.enter_context(contextlib.closing(Running(*words, **options)))


@pytest.fixture
def hear_until() -> Callable[..., None]:
    def hear(running: Running, true: Callable[[], Any], send: Callable[[], None] = lambda: None) -> None:
        for _ in range(LOOKS):
            send()
            running.hear(0.1)
            if true():
                return
        pytest.fail(f"The expected state was not reached: {running.state}")

    return hear
