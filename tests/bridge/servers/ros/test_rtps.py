"""Services over DDS on a network that loses packets, and invalid packets."""

from __future__ import annotations

import contextlib
import random
import socket
from collections.abc import Callable, Iterator
from itertools import count
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("cyclonedds", reason="the extra ros is not installed")

from armlab.bridge.servers.ros import rtps
from armlab.bridge.servers.ros.dds import joined
from armlab.bridge.servers.ros.rtps import ServiceServers
from armlab.bridge.servers.ros.services import Service, register
from armlab.bridge.servers.ros.topics import store

from .dds_peers import Node, free_domain

TYPE = "armlab_test/srv/Length"
LOST = 0.2


def lossy(seed: int) -> type[socket.socket]:
    rng = random.Random(seed)

    class Lossy(socket.socket):
        def recv(self, *given: Any) -> bytes:
            data = super().recv(*given)
            return b"" if rng.random() < LOST else data

        def sendto(self, data: Any, *given: Any) -> int:
            return len(data) if rng.random() < LOST else super().sendto(data, *given)

    return Lossy


def answer(service: Service, cdr: bytes, client: str, send: Callable[[bytes], None]) -> None:
    length = len(store().deserialize_cdr(cdr, f"{TYPE}_Request").text)
    send(bytes(store().serialize_cdr(store().types[f"{TYPE}_Response"](length), f"{TYPE}_Response")))


@pytest.fixture
def servers() -> Iterator[Callable[[], ServiceServers]]:
    found: list[ServiceServers] = []
    register({TYPE: ("string text", "uint64 length")})
    domain = free_domain()

    def make() -> ServiceServers:
        found.append(ServiceServers(domain, "127.0.0.1", [Service("/length", TYPE, lambda *_: None)], answer))
        return found[-1]

    with joined(domain, "127.0.0.1"):
        yield make
    for one in found:
        one.close()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_every_call_is_answered_though_a_fifth_of_all_packets_is_lost(
    servers: Any, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rtps, "socket", SimpleNamespace(**{**vars(socket), "socket": lossy(seed)}))
    call = Node(servers()._domain).caller("/length", TYPE)
    for k in range(20):
        size = 250_000 if k % 4 == 3 else 10 + k
        assert call(store().types[f"{TYPE}_Request"]("a" * size)).length == size


def test_a_node_that_was_forgotten_is_found_again(servers: Any) -> None:
    server = servers()
    node = Node(server._domain)
    request = store().types[f"{TYPE}_Request"]("word")
    assert node.call("/length", TYPE, request).length == 4
    with server._lock:
        for prefix in list(server._peers):
            server._forget(prefix)
    assert node.call("/length", TYPE, request).length == 4


PEER = b"peer" * 3
KINDS = (rtps._DATA, rtps._FRAGMENT, rtps._HEARTBEAT, rtps._ACKNACK, rtps._GAP, rtps._SOURCE, rtps._DESTINATION)
WRITERS = (rtps._SPDP, rtps._PUBLICATIONS, rtps._SUBSCRIPTIONS, b"\0\0\1\3")


@given(
    st.lists(st.tuples(st.sampled_from(KINDS), st.integers(0, 255), st.sampled_from(WRITERS), st.binary(max_size=80)))
)
def test_malformed_packets_of_a_known_node_are_dropped(parts: list[tuple[int, int, bytes, bytes]]) -> None:
    server = ServiceServers.__new__(ServiceServers)
    server._prefix, server._is_local, server._counts, server._topics = b"ours" * 3, True, count(1), {}
    server._peers = {PEER: rtps._Peer(("127.0.0.1", 9), ("127.0.0.1", 9), 10.0)}
    server._writers = {id_: rtps._Writer(id_) for id_ in WRITERS[1:]}
    server._publications, server._subscriptions = (server._writers[id_] for id_ in WRITERS[1:3])
    server._readers, server._clients, server._services = {PEER + WRITERS[3]: rtps._Reader()}, {}, {}
    server._left = server._send = lambda *_: None  # type: ignore[method-assign]
    packet = b"RTPS\2\3\1\x10" + PEER
    for kind, flags, writer, body in parts:
        packet += rtps._message(kind, flags, body[:4] + writer + body)
    with contextlib.suppress(rtps.struct.error, IndexError, ValueError):
        server._receive(packet)
    for one in server._readers.values():
        assert len(one.early) <= rtps._WINDOW
        assert len(one.partial) <= rtps._PARTIAL
