"""One connection: its queue and its patience, without waiting for either."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest

from armlab.bridge.servers.labcomm.connection import QUEUE, Peer
from armlab.errors import LabCommError
from armlab.wire.labcomm import Encoder, Version


@pytest.fixture
def pair() -> Iterator[tuple[Peer, socket.socket]]:
    listener = socket.create_server(("127.0.0.1", 0))
    other = socket.create_connection(listener.getsockname())
    ours, _ = listener.accept()
    listener.close()
    other.settimeout(10.0)
    yield Peer(ours, "test", Encoder()), other
    ours.close()
    other.close()


def test_a_full_queue_loses_the_oldest_data_and_no_definition(pair: tuple[Peer, socket.socket]) -> None:
    peer, other = pair
    assert QUEUE == 64
    peer.push(b"DEF0", may_drop=False)
    for k in range(QUEUE + 9):
        peer.push(b"%04d" % k)
    peer.push(b"DEF1", may_drop=False)
    assert (peer.dropped, peer.is_waiting) == (11, True)
    assert peer.flush()
    assert not peer.is_waiting
    expected = b"DEF0" + b"".join(b"%04d" % k for k in range(11, QUEUE + 9)) + b"DEF1"
    data = b""
    while len(data) < len(expected):
        data += other.recv(4096)
    assert data == expected


def test_newer_data_replaces_what_waits(pair: tuple[Peer, socket.socket]) -> None:
    peer, other = pair
    peer.push(b"DEF", may_drop=False)
    peer.push(b"old")
    peer.clear()
    peer.push(b"new")
    assert peer.flush()
    assert peer.dropped == 1
    data = b""
    while len(data) < 6:
        data += other.recv(6)
    assert data == b"DEFnew"


def test_a_peer_that_takes_nothing_is_overdue(pair: tuple[Peer, socket.socket]) -> None:
    peer, other = pair
    for _ in range(200):
        peer.push(bytes(60_000))
        assert peer.flush()
    assert peer.dropped > 0
    assert peer.is_stuck
    assert peer.overdue(peer.began + 1.0) == ""
    assert "took nothing" in peer.overdue(peer.began + 60.0)
    other.close()
    while peer.flush():
        pass  # the system tells the end of the connection with one of the next writes


def test_a_packet_that_stays_incomplete_is_overdue(pair: tuple[Peer, socket.socket]) -> None:
    peer, other = pair
    assert peer.overdue(peer.began + 60.0) == "", "a silent peer is no fault"
    other.sendall(Encoder().version()[:5])
    while peer.decoder.pending < 5:
        assert peer.read() == []
    assert peer.overdue(peer.began + 61.0) == ""
    assert peer.overdue(peer.began + 64.9) == ""
    assert "not complete" in peer.overdue(peer.began + 65.1)
    other.sendall(Encoder().version()[5:])
    while not (events := peer.read()):
        pass
    assert events == [Version("LabComm2014.v1")]
    assert peer.overdue(peer.began + 200.0) == ""
    peer.close()
    assert peer.read() is None


def test_the_end_of_a_stream(pair: tuple[Peer, socket.socket]) -> None:
    peer, other = pair
    other.sendall(Encoder().version()[:5])
    while peer.decoder.pending < 5:
        peer.read()
    other.close()
    peer.socket.setblocking(True)
    with pytest.raises(LabCommError, match="after 5 bytes"):
        peer.read()
