"""The socket to a server process."""

from __future__ import annotations

import socket

from armlab.bridge.net.sockets import Outlet, pair


def test_a_pair_keeps_messages_whole() -> None:
    ours, theirs = pair()
    assert not ours.getblocking()
    ours.send(b"one")
    ours.send(b"two")
    assert theirs.recv(100) == b"one"
    assert isinstance(theirs, socket.socket)
    ours.close()
    theirs.close()


def test_a_closed_outlet_is_silent() -> None:
    outlet = Outlet("x")
    assert not outlet.send(b"a")
    outlet.row(b"b")
    assert (outlet.rows, outlet.lost) == (0, 1)
    assert outlet.receive() is None
    outlet.close()
