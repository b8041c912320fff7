"""A router, and bridges that publish synthetic rows over Zenoh, all in the test process."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from armlab.bridge.servers.hub import Hub
from armlab.bridge.servers.zenoh.messages import EVERY
from armlab.bridge.servers.zenoh.process import ZenohProcess
from armlab.bridge.servers.zenoh.session import LabAddress, close_session, open_session
from armlab.live.fleet_view import FleetRows
from armlab.log import Tick
from armlab.robots import Robot
from armlab.state import State

from ..processes import free_port

PATIENCE = 60.0  # s; only a test that fails waits so long
PERIOD = 0.02  # s between two rows


class FleetBridge:
    def __init__(self, router: int, robot: Robot, lab: str) -> None:
        self.robot, self.q = robot, np.array(robot.q_home)
        self._exchange = Hub([robot], ["zenoh"], about={"cell": robot.name})
        self._far = self._exchange.open("zenoh")
        options = {"lab": lab, "host": "127.0.0.1", "port": 0, "router": f"127.0.0.1:{router}"}
        self._process = ZenohProcess(self._far, options)
        self._over = threading.Event()
        self._threads = [threading.Thread(target=one) for one in (self._process.run, self._send)]
        for one in self._threads:
            one.start()

    def _send(self) -> None:
        tick, nothing = 0, 0 * self.q
        while not self._over.wait(PERIOD):
            state = State(PERIOD * tick, PERIOD, self.q, nothing, nothing, robot=self.robot.name, seq=tick)
            now = time.time_ns()
            self._exchange.row(state, None, Tick(tick, -1, now, now, -1, 0))
            self._exchange.poll()
            tick += 1

    def close(self) -> None:
        if not self._over.is_set():
            self._over.set()
            self._threads[1].join(PATIENCE)
            self._exchange.close()
            self._threads[0].join(PATIENCE)
            self._far.close()
            assert not any(one.is_alive() for one in self._threads)


class Fleet:
    def __init__(self) -> None:
        self.port = free_port()
        self._router = open_session("router", [f"127.0.0.1:{self.port}"])
        self._bridges: list[FleetBridge] = []
        self._heard: list[FleetRows] = []

    def bridge(self, robot: Robot, name: str = "", lab: str = "lab1") -> FleetBridge:
        self._bridges.append(FleetBridge(self.port, replace(robot, name=name or robot.name), lab))
        return self._bridges[-1]

    def rows(self, lab: str = EVERY) -> FleetRows:
        self._heard.append(FleetRows(LabAddress(port=self.port, lab=lab)))
        return self._heard[-1]

    def put(self, where: str, data: bytes) -> None:
        self._router.put(where, data)

    def close(self) -> None:
        for one in (*self._heard, *self._bridges):
            one.close()
        close_session(self._router)


def hear_fleet(rows: FleetRows, condition: Any, draw: Any = lambda: None) -> None:
    until = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < until, {name: one.state for name, one in rows.robots.items()}
        rows.hear(0.05)
        draw()


@pytest.fixture
def fleet(monkeypatch: pytest.MonkeyPatch) -> Iterator[Fleet]:
    pytest.importorskip("zenoh", reason="many robots need the extra `net`")
    monkeypatch.setattr("armlab.bridge.servers.zenoh.process._STATUS", 10**8)
    monkeypatch.setattr("armlab.bridge.servers.zenoh.feed._DISCOVERY", 0.1)
    one = Fleet()
    yield one
    one.close()
