"""TCP ports of a server: free, taken, of another computer."""

from __future__ import annotations

import os
import socket

import pytest

from armlab.bridge.net.sockets import listening_socket
from armlab.errors import LinkError


def test_a_port_that_is_taken_names_who_has_it() -> None:
    with listening_socket("127.0.0.1", 0, "left", 2) as one:
        assert not one.getblocking()
        port = one.getsockname()[1]
        words = rf"TCP port 127.0.0.1:{port} for right to be free, but it is in use by process {os.getpid()} \("
        with pytest.raises(LinkError, match=words):
            listening_socket("127.0.0.1", port, "right", 2)


def test_small_messages_wait_for_no_acknowledgement() -> None:
    """A client acknowledges after up to 40 ms; with Nagle's algorithm the next message would wait for that."""
    with listening_socket("127.0.0.1", 0, "left", 2) as listener:
        listener.setblocking(True)
        with socket.create_connection(listener.getsockname()), listener.accept()[0] as accepted:
            assert accepted.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)


@pytest.mark.parametrize(("host", "port"), [("203.0.113.7", 7511), ("127.0.0.1", 70_000)])
def test_an_address_that_is_none_of_ours(host: str, port: int) -> None:
    with pytest.raises(LinkError, match=f"Expected TCP port {host}:{port} for left to be free, but"):
        listening_socket(host, port, "left", 2)
