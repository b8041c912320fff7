"""Servers on local ports, and plain clients that read all data."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import pytest

from armlab.bridge.servers.labcomm import LabCommServer, Row
from armlab.bridge.servers.labcomm.channels import Channel
from armlab.wire.labcomm import Decoder
from armlab.wire.labcomm.types import Event

from ..conftest import PATIENCE, until


def row(tm: int) -> Row:
    return Row(tm, np.arange(7.0) + tm, np.arange(7.0) / 8, np.arange(7.0) - tm)


class Plain:
    def __init__(self, port: int) -> None:
        self.socket = socket.create_connection(("127.0.0.1", port), timeout=PATIENCE)
        self.decoder = Decoder()
        self.events: list[Event] = []

    def read(self, count: int) -> list[Event]:
        while len(self.events) < count:
            data = self.socket.recv(4096)
            assert data, f"closed after {len(self.events)} events"
            self.events += self.decoder.feed(data)
        return self.events

    def is_closed(self) -> bool:
        try:
            while self.socket.recv(65536):
                pass
        except ConnectionError:
            pass
        return True


class Started:
    def __init__(self, channels: Sequence[Channel]) -> None:
        self.said: list[str] = []
        self.server = LabCommServer(channels, on_event=self.tell)
        self.clients: list[Plain] = []

    def tell(self, text: str, warn: bool = False) -> None:
        self.said.append(text)

    def client(self, name: str) -> Plain:
        client = Plain(self.server.ports[name])
        self.clients.append(client)
        address = "{}:{}".format(*client.socket.getsockname())
        until(lambda: any(address in text for text in self.said))
        return client


@pytest.fixture
def start() -> Iterator[Callable[..., Started]]:
    started: list[Started] = []

    def make(*channels: Channel) -> Started:
        started.append(Started(channels))
        return started[-1]

    yield make
    for one in started:
        for client in one.clients:
            client.socket.close()
        one.server.close()
