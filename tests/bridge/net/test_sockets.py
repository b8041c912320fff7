"""The socket."""

from __future__ import annotations

import os
import select
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from armlab.bridge.net.sockets import Arrival, Outlet, Port, listening_socket, pair, process_using_port, program
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


@pytest.mark.parametrize("kind", ["udp", "tcp"])
def test_the_holder_of_a_port_is_named(kind: str) -> None:
    code = (
        "import socket, sys\n"
        f"s = socket.socket(socket.AF_INET, socket.SOCK_{'DGRAM' if kind == 'udp' else 'STREAM'})\n"
        "s.bind(('127.0.0.1', 0))\n"
        f"{'s.listen()' if kind == 'tcp' else ''}\n"
        "print(s.getsockname()[1], flush=True); sys.stdin.read()"
    )
    command = [sys.executable, "-S", "-c", code]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        number = int(other.stdout.readline())
        assert process_using_port(number, kind).startswith(f"process {other.pid} (")  # type: ignore[arg-type]
        assert process_using_port(number, "tcp" if kind == "udp" else "udp") == ""


def test_nobody_holds_a_free_port() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        number = free.getsockname()[1]
    assert process_using_port(number) == ""


def test_a_connection_is_no_listener() -> None:
    """Nor is a client whose own end has that number."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        with socket.create_connection(server.getsockname()) as client:
            assert process_using_port(client.getsockname()[1], "tcp") == ""
        assert str(os.getpid()) in process_using_port(server.getsockname()[1], "tcp")


def test_a_process_that_is_gone() -> None:
    assert program(os.getpid()).startswith(f"process {os.getpid()} (")
    assert program(2**22 + 1) == f"process {2**22 + 1}"


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
