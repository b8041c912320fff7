"""The socket."""

from __future__ import annotations

import os
import select
import subprocess
import sys
import time
from pathlib import Path

import pytest

from armlab.bridge.net.sockets import Arrival, Port
from armlab.errors import LinkError


def arrived(port: Port, seconds: float) -> bool:
    return bool(select.select([port.fileno()], [], [], seconds)[0])


def test_send_and_receive() -> None:
    one, two = Port("127.0.0.1", 0), Port("127.0.0.1", 0)
    assert one.receive() is None
    assert not arrived(one, 0.0)
    before = time.monotonic_ns()
    assert two.send(b"abc", (one.host, one.port))
    assert arrived(one, 5.0)
    arrival = one.receive()
    assert isinstance(arrival, Arrival)
    assert (arrival.data, arrival.source) == (b"abc", (two.host, two.port))
    assert before - 1_000_000 <= arrival.ns <= time.monotonic_ns()
    one.close()
    two.close()


def test_the_stamp_is_the_arrival_not_the_reading() -> None:
    port = Port("127.0.0.1", 0)
    port.send(b"", (port.host, port.port))
    assert arrived(port, 5.0)
    time.sleep(0.05)  # Linux begins to stamp a moment after the first socket that asks for it
    port.receive()
    port.send(b"", (port.host, port.port))
    assert arrived(port, 5.0)
    reading = time.monotonic_ns()
    time.sleep(0.01)
    arrival = port.receive()
    assert arrival is not None
    assert arrival.ns < reading + 1_000_000
    port.close()


def test_flush() -> None:
    port = Port("127.0.0.1", 0)
    for _ in range(5):
        port.send(b"old", (port.host, port.port))
    assert arrived(port, 5.0)
    port.flush()
    assert port.receive() is None
    port.close()


def test_errors_are_counted_not_raised() -> None:
    port = Port("127.0.0.1", 0)
    assert not port.send(b"x" * 70_000, ("127.0.0.1", port.port))
    assert port.errors == 1
    port.close()


@pytest.mark.parametrize("is_replaced", [False, True])
def test_a_socket_that_other_code_closed_is_bound_again(is_replaced: bool, tmp_path: Path) -> None:
    port, peer, lost = Port("127.0.0.1", 0), Port("127.0.0.1", 0), []
    address, number = (port.host, port.port), port.fileno()
    port.on_lost = lambda: lost.append(True)
    os.close(number)
    if is_replaced:
        assert os.open(tmp_path / "other", os.O_CREAT | os.O_RDWR) == number
    assert port.receive() is None
    assert lost == [True]
    assert port.send(b"abc", (peer.host, peer.port))
    assert arrived(peer, 5.0)
    arrival = peer.receive()
    assert arrival is not None
    assert arrival.source == address
    assert port.errors == 1
    os.close(port.fileno())
    assert port.send(b"abc", (peer.host, peer.port)), "also when it sends first"
    assert len(lost) == port.errors == 2
    assert peer.errors == 0
    port.close()
    peer.close()
    if is_replaced:
        os.write(number, b"theirs")
        os.close(number)
        assert (tmp_path / "other").read_bytes() == b"theirs"


def test_a_socket_whose_number_another_file_has_is_not_closed(tmp_path: Path) -> None:
    port = Port("127.0.0.1", 0)
    number = port.fileno()
    os.close(number)
    assert os.open(tmp_path / "other", os.O_CREAT | os.O_WRONLY) == number
    port.close()
    os.write(number, b"theirs")
    os.close(number)


def test_a_port_in_use_names_its_holder() -> None:
    code = (
        "import socket, sys\ns = socket.socket(socket.AF_INET, socket.SOCK_DGRAM); s.bind(('127.0.0.1', 0)); "
        "print(s.getsockname()[1], flush=True); sys.stdin.read()"
    )
    command = [sys.executable, "-c", code]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        number = int(other.stdout.readline())
        with pytest.raises(
            LinkError, match=rf"127.0.0.1:{number} .* in use by process {other.pid} \(.*python.*End that"
        ):
            Port("127.0.0.1", number)


@pytest.mark.parametrize("host", ["203.0.113.7", "no such host"])
def test_an_address_of_another_computer(host: str) -> None:
    with pytest.raises(LinkError, match=f"Expected a local address to listen on, got {host}:6510"):
        Port(host, 6510)
