"""Sockets, and the messages reported by the parts of a run."""

from __future__ import annotations

import logging
import os
import select
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from armlab.bridge.control.recording import Recording
from armlab.bridge.net.events import Limited, Tell
from armlab.bridge.net.sockets import Arrival, Outlet, Port, listening_socket, pair, process_using_port, program
from armlab.errors import LinkError
from armlab.robots import Robot


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
    for _ in range(5):
        two.send(b"old", (one.host, one.port))
    assert arrived(one, 5.0)
    one.flush()
    assert one.receive() is None
    assert not two.send(b"x" * 70_000, (one.host, one.port))
    assert two.errors == 1, "counted, not raised"
    one.close()
    two.close()


def test_the_stamp_is_the_arrival_not_the_reading() -> None:
    port = Port("127.0.0.1", 0)
    port.send(b"", (port.host, port.port))
    assert arrived(port, 5.0)
    time.sleep(0.05)  # Linux starts to stamp arrivals a moment after the first socket requests it
    port.receive()
    port.send(b"", (port.host, port.port))
    assert arrived(port, 5.0)
    reading = time.monotonic_ns()
    time.sleep(0.01)
    arrival = port.receive()
    assert arrival.ns < reading + 1_000_000
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
    assert arrival.source == address
    assert port.errors == 1
    os.close(port.fileno())
    assert port.send(b"abc", (peer.host, peer.port)), "even if the port sends first"
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
        number = int(other.stdout.readline())
        assert process_using_port(number, kind).startswith(f"process {other.pid} (")  # type: ignore[arg-type]
        assert process_using_port(number, "tcp" if kind == "udp" else "udp") == ""


def test_who_has_no_port() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        with socket.create_connection(server.getsockname()) as client:
            number = client.getsockname()[1]
            assert process_using_port(number, "tcp") == ""
        assert str(os.getpid()) in process_using_port(server.getsockname()[1], "tcp")
    assert process_using_port(number) == ""
    assert program(os.getpid()).startswith(f"process {os.getpid()} (")
    assert program(2**22 + 1) == f"process {2**22 + 1}"


def test_a_listening_socket() -> None:
    """The error for a port in use names its process; Nagle's algorithm is off, so messages do not wait for an ACK."""
    with listening_socket("127.0.0.1", 0, "left", 2) as listener:
        assert not listener.getblocking()
        port = listener.getsockname()[1]
        words = rf"TCP port 127.0.0.1:{port} for right to be free, got a port in use by process {os.getpid()} \("
        with pytest.raises(LinkError, match=words):
            listening_socket("127.0.0.1", port, "right", 2)
        listener.setblocking(True)
        with socket.create_connection(listener.getsockname()), listener.accept()[0] as accepted:
            assert accepted.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)


@pytest.mark.parametrize(("host", "port"), [("203.0.113.7", 7511), ("127.0.0.1", 70_000)])
def test_an_address_that_is_none_of_ours(host: str, port: int) -> None:
    with pytest.raises(LinkError, match=f"Expected TCP port {host}:{port} for left to be free, got"):
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
    outlet = Outlet("x")  # never opened
    assert not outlet.send(b"a")
    outlet.row(b"b")
    assert (outlet.rows, outlet.lost) == (0, 1)
    assert outlet.receive() is None
    outlet.close()


def test_what_is_wrong_is_a_warning(robot: Robot, caplog: pytest.LogCaptureFixture) -> None:
    recording = Recording(robot, None, None, wait=False, clock=lambda: 7)
    tell: Tell = recording.event
    with caplog.at_level(logging.INFO, "armlab.bridge"):
        tell("All is well.")
        tell("The motors are off.", warn=True)
        assert not caplog.records, "events wait for the reply"
        recording.catch_up()
    assert [(record.levelname, record.getMessage()) for record in caplog.records] == [
        ("INFO", "All is well."),
        ("WARNING", "The motors are off."),
    ]
    assert list(recording.events) == [(7, "All is well."), (7, "The motors are off.")]


SECOND = 10**9


def told_of(*said: tuple[str, float], each: bool = False) -> list[tuple[str, int]]:
    """Report messages at given times [s]; return those that pass the rate limit, with their stamps [ns]."""
    told: list[tuple[str, int]] = []
    limited = Limited(lambda text, warn, stamp_ns: told.append((text, stamp_ns)))
    for text, seconds in said:
        limited(text, False, round(SECOND * seconds), each)
    limited.close()
    return told


def test_of_a_kind_one_a_second() -> None:
    said = [(f"Joint {k} of 'a{k}' flaps.", 0.1 * k) for k in range(25)]
    assert told_of(*said) == [
        ("Joint 0 of 'a0' flaps.", 0),
        ("Joint 9 of 'a9' flaps. (8 similar events skipped.)", 900_000_000),
        ("Joint 19 of 'a19' flaps. (9 similar events skipped.)", 1_900_000_000),
        ("Joint 24 of 'a24' flaps. (4 similar events skipped.)", 2_400_000_000),
    ]


def test_what_must_be_told_one_by_one_is_unless_it_floods() -> None:
    said = [(f"zenoh {k} commands arm.", 0.1 * k) for k in range(100)]
    assert [text for text, _ in told_of(*said, each=True)] == [text for text, _ in said]
    others = [("Ready.", 0.0), ("Not ready.", 0.1), ("Stopped by a 1.", 0.2), ("Ready.", 0.3), ("Not ready.", 5.0)]
    assert [text for text, _ in told_of(*others)] == [text for text, _ in others]
    told = told_of(*((f"zenoh {k} commands arm.", 0.004 * k) for k in range(1000)), each=True)
    assert len(told) == 4 * 50 + 1
    assert told[50] == ("zenoh 249 commands arm. (199 similar events skipped.)", 996_000_000)


def test_a_clock_that_begins_anew() -> None:
    assert len(told_of(("A.", 100.0), ("A.", 0.0), ("A.", 0.5), ("A.", 1.0))) == 4


@given(st.lists(st.tuples(st.integers(0, 200), st.floats(0.0, 0.3)), max_size=400))
def test_nothing_is_lost_without_being_counted(steps: list[tuple[int, float]]) -> None:
    now, said = 0.0, []
    for kind, wait in steps:
        now += wait
        said.append((f"{'x' * kind} {now}", now))
    told = told_of(*said)
    left_out = sum(int(text.partition("(")[2].split()[0]) for text, _ in told if "(" in text)
    assert len(told) + left_out == len(said)
    assert len(told) <= 2 * 65 * (int(now) + 2)


def test_a_recording_keeps_what_waited(robot: Robot) -> None:
    stamps = [0]
    recording = Recording(robot, None, None, wait=False, clock=lambda: stamps[0])
    for k in range(1000):
        stamps[0] = 4_000_000 * (k + 1)
        recording.event(
            "The robot is ready and holds its position." if k % 2 else "The robot is not ready: the motors are off."
        )
        recording.catch_up()
    recording.close({})
    assert 8 <= len(recording.events) <= 10
    assert recording.events[-1] == (
        stamps[0],
        "The robot is ready and holds its position. (124 similar events skipped.)",
    )
