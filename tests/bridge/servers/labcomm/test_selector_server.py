"""The sockets of a server, turn by turn in this thread."""

from __future__ import annotations

import select
import socket
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from armlab.bridge.net.events import nobody
from armlab.bridge.servers.labcomm import ArmChannel
from armlab.bridge.servers.labcomm.rows import STOP
from armlab.bridge.servers.labcomm.selector_server import Ports
from armlab.errors import LinkError
from armlab.wire.labcomm import Encoder, Sample, parse_lc
from armlab.wire.labcomm.types import SampleType

from .conftest import Plain, row, until

TURNS = 200  # of 50 ms at most; only a test that fails waits so long


class Bench:
    """Ports of one channel, and what they said."""

    def __init__(self) -> None:
        self.said: list[str] = []
        self.stops: list[str] = []
        self.clients: list[Plain] = []
        self.ours, self.beside = socket.socketpair()
        told: Callable[..., Any] = lambda text, warn=False: self.said.append(text)  # noqa: E731
        self.ports = Ports([ArmChannel("left", 0)], "127.0.0.1", told, self.stops.append, self.beside)

    def until(self, condition: Callable[[], Any]) -> None:
        for _ in range(TURNS):
            if condition():
                return
            self.ports.turn()
        raise AssertionError("it did not happen")

    def client(self) -> Plain:
        client = Plain(self.ports.numbers["left"])
        self.clients.append(client)
        address = "{}:{}".format(*client.socket.getsockname())
        self.until(lambda: any(address in text for text in self.said))
        return client

    def close(self) -> None:
        for client in self.clients:
            client.socket.close()
        self.ports.close()
        self.ours.close()
        self.beside.close()


@pytest.fixture
def bench() -> Iterator[Bench]:
    one = Bench()
    yield one
    one.close()


def test_rows_go_out_and_what_clients_send_comes_in(bench: Bench) -> None:
    assert not bench.ports.has_clients("left")
    bench.ports.put("left", row(1))  # for nobody
    client, encoder = bench.client(), Encoder()
    assert bench.ports.has_clients("left")
    assert not bench.ports.has_clients("fused")
    bench.ports.put("left", row(2))
    assert client.read(3)[-1].value["tm"] == 2
    client.socket.sendall(encoder.version() + encoder.define(STOP) + encoder.data(STOP, {}))
    bench.until(lambda: bench.stops)
    address = "{}:{}".format(*client.socket.getsockname())
    assert bench.stops == [address]
    client.socket.close()
    bench.until(lambda: not bench.ports.has_clients("left"))
    assert bench.ports.clients == {f"left {address}": (1, 0)}
    assert bench.ports.counts["left"] == {"clients": 0, "dropped": 0}


def test_a_client_that_reads_again_gets_what_waited(bench: Bench) -> None:
    """The rest goes out when the system takes it, with no row to push it."""
    client = bench.client()
    (peer,) = bench.ports._peers["left"]
    sent = 0
    while not peer.is_stuck:
        bench.ports.put("left", row(sent))
        sent += 1
        assert sent < 10**6
    numbers: list[int] = []
    client.socket.setblocking(False)

    def reads() -> bool:
        try:
            data = client.socket.recv(2**20)
        except BlockingIOError:
            return False
        numbers.extend(event.value["tm"] for event in client.decoder.feed(data) if isinstance(event, Sample))
        return numbers[-1:] == [sent - 1]

    bench.until(reads)
    assert numbers == list(range(sent))
    assert not peer.is_waiting
    assert not bench.ports._full


def test_what_comes_beside_ends_a_turn(bench: Bench) -> None:
    """And it is left to its owner."""
    bench.ours.send(b"x")
    assert not bench.ports.turn()
    assert bench.beside.recv(1) == b"x"


def test_clients_share_what_a_turn_reads(bench: Bench) -> None:
    encoder = Encoder()
    raw = encoder.version() + encoder.define(STOP) + 30_000 * encoder.data(STOP, {})
    clients = [bench.client() for _ in range(4)]
    for client in clients:
        client.socket.sendall(raw)
    peers = bench.ports._peers["left"]
    until(lambda: len(select.select([peer.socket for peer in peers], [], [], 0.0)[0]) == 4)
    for k in range(1, 20):
        assert bench.ports.turn()
        read = [peer.decoder.offset + peer.decoder.pending for peer in peers]
        assert read == 4 * [1024 * k]
        assert len(bench.stops) == 4 * k, "one stop of a read is enough"


def test_what_was_not_taken_is_told_once_and_counted(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    client, encoder, (nothing,) = bench.client(), Encoder(), parse_lc("sample void x;")
    assert isinstance(nothing, SampleType)
    client.socket.sendall(encoder.version() + encoder.define(nothing) + 1500 * encoder.data(nothing, {}))
    bench.until(lambda: bench.ports.counts["left"].get("other type") == 1500)
    assert sum("was not taken (1 so far), LabCommError" in text for text in bench.said) == 1
    assert len(bench.said) == 2
    monkeypatch.setattr("armlab.bridge.servers.labcomm.selector_server._EVERY", 0.0)
    client.socket.sendall(encoder.data(nothing, {}))
    bench.until(lambda: any("was not taken (1501 so far)" in text for text in bench.said))
    client.socket.close()
    bench.until(lambda: bench.said[-1].endswith("left; 1501 samples of it were not taken."))


def test_a_port_that_is_taken_leaves_none_open(bench: Bench) -> None:
    ours, beside = socket.socketpair()
    taken = bench.ports.numbers["left"]
    with ours, beside, pytest.raises(LinkError, match="for right to be free"):
        Ports([ArmChannel("left", 0), ArmChannel("right", taken)], "127.0.0.1", nobody, nobody, beside)
