"""Datagrams through the compiled kernel and through Python's own calls."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from importlib.util import find_spec
from typing import Any, NamedTuple

import pytest

from armlab.kernels import _reference

if find_spec("armlab.kernels._native") is None:
    pytest.skip("the extension is not built", allow_module_level=True)

from armlab.kernels import _native


class Kind(NamedTuple):
    data: bytes
    source: tuple[str, int]
    ns: int


@pytest.fixture(params=[_native, _reference])
def pair(request: Any) -> Iterator[tuple[Any, Any, tuple[str, int]]]:
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)]
    for one in sockets:
        one.bind(("127.0.0.1", 0))
        one.setblocking(False)
    sockets[1].setsockopt(socket.SOL_SOCKET, 35, 1)  # SO_TIMESTAMPNS
    sender, receiver = (request.param.Datagrams(one, Kind) for one in sockets)
    yield sender, receiver, sockets[1].getsockname()
    for one in (sender, receiver):
        one.close()
        assert one.receive() is None
        assert one.errors  # a closed one reads nobody else's datagrams


def test_they_arrive_in_order_with_stamps(pair: Any) -> None:
    sender, receiver, address = pair
    assert receiver.receive() is None
    texts = [b"", b"one", bytes(range(256)) * 200, b"\0last"]
    before = time.monotonic_ns()
    for text in texts:
        assert sender.send(text, address)
    found = [receiver.receive() for _ in texts]
    after = time.monotonic_ns()
    assert [one.data for one in found] == texts
    for one in found:
        assert type(one) is Kind
        assert one.source[0] == "127.0.0.1"
        assert before - 1_000_000 <= one.ns <= after
    assert receiver.receive() is None
    assert (sender.errors, receiver.errors) == (0, 0)
    assert sender.send(b"x", found[0].source)  # back to the sender, by its address
    assert sender.receive().data == b"x"


def test_errors_are_counted(pair: Any) -> None:
    sender, _, address = pair
    assert not sender.send(b"x" * 70_000, address)
    assert sender.errors == 1
