"""An engine with a loop that only records requests, and clients that send and receive JSON."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.bridge.inputs.parameters import Parameter, Parameters
from armlab.bridge.servers.messages import Report, Request, parameter_message
from armlab.bridge.servers.rosbridge.engine import ClientSession, Engine
from armlab.bridge.servers.row import RowSchema, RowWriter
from armlab.log import Tick
from armlab.robots import Robot, to_toml
from armlab.state import State

MS = 1_000_000  # ns
HANDSHAKE = (
    b"GET / HTTP/1.1\r\nHost: a\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
)


ARMS = [robots.load("yumi_left"), robots.load("yumi_right")]


class Loop:
    def __init__(self) -> None:
        self.robot = ARMS[0]
        self.schema = RowSchema.of(ARMS)
        self.about: dict[str, Any] = {"cell": "yumi", "robots": {arm.name: to_toml(arm) for arm in ARMS}}
        self.declared = Parameters(
            [Parameter("gain", 0.5, unit="N/m", minimum=0.0, maximum=1.0), Parameter("note", "a", "text")]
        )
        self.asked: list[Request] = []
        self.reports: list[str] = []
        self.tell()

    def robots(self) -> dict[str, Robot]:
        return {arm.name: arm for arm in ARMS}

    def ask(self, request: Request) -> bool:
        if isinstance(request, Report):
            self.reports.append(request.text)
        else:
            self.asked.append(request)
        return True

    def tell(self) -> dict[str, Any]:
        message: dict[str, Any] = json.loads(parameter_message(self.declared))
        self.parameters = {one["name"]: one for one in message["parameters"]}
        return message


class Bench:
    def __init__(self) -> None:
        self.loop = Loop()
        self.engine = Engine(self.loop)
        self.writer = RowWriter(self.loop.schema)
        self.now = 10**12

    def client(self, name: str = "127.0.0.1:5000", may_ask: bool = True) -> ClientSession:
        return self.engine.join(name, may_ask)

    def say(self, client: ClientSession, text: str | bytes | None = None, **operation: Any) -> None:
        self.engine.take(client, json.dumps(operation) if text is None else text, self.now)

    def ask(self, client: ClientSession, service: str, **fields: Any) -> Any:
        self.say(client, op="call_service", service=service, **fields)
        (answer,) = self.heard(client)
        assert (answer["op"], answer["service"]) == ("service_response", service)
        assert isinstance(answer["values"], dict if answer["result"] else str)
        return answer["values"]

    def heard(self, client: ClientSession) -> list[Any]:
        return [json.loads(one) for one in client.outbox.take(2**30)]

    def row(self, after_ms: float = 4.0, **fields: Any) -> None:
        self.now += int(after_ms * MS)
        robot = self.loop.robot
        q = np.array(robot.q_home)
        state = State(t=1.5, dt=0.004, q=q, qd=np.zeros(7), tau=np.full(7, np.nan), robot=robot.name, **fields)
        data = self.writer.row(state, None, Tick(0, -1, 5_000_000_250, 0, -1, 0), self.now)
        self.engine.row(data, self.now)


@pytest.fixture
def bench() -> Bench:
    return Bench()
