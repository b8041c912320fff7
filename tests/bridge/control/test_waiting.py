"""Prediction of arrivals, and the three ways of waiting."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import get_args

import pytest

from armlab.bridge.control.realtime import Prediction, Wait, Waiting
from armlab.bridge.net.sockets import Port

MS = 1_000_000


def test_there_is_no_prediction_before_the_first_packet() -> None:
    assert Prediction().next_ns is None


def test_early_pulls_fully_late_by_two_percent() -> None:
    prediction = Prediction()
    prediction.add(100 * MS, 1, 0.004)
    assert prediction.next_ns == 104 * MS
    prediction.add(103 * MS, 1, 0.004)
    assert prediction.next_ns == 107 * MS
    prediction.add(108 * MS, 1, 0.004)
    assert prediction.next_ns == pytest.approx(111.02 * MS)


def test_lost_packets_and_stalls() -> None:
    prediction = Prediction()
    prediction.add(0, 1, 0.004)
    prediction.add(12 * MS, 3, 0.004)
    assert prediction.next_ns == 16 * MS
    prediction.add(500 * MS, 1, 0.004)
    assert prediction.next_ns == 504 * MS


@pytest.fixture
def port() -> Iterator[Port]:
    port = Port("127.0.0.1", 0)
    yield port
    port.close()


@pytest.mark.parametrize("mode", get_args(Wait))
def test_what_is_there_is_returned_at_once(port: Port, mode: Wait) -> None:
    waiting = Waiting([port], [Prediction()], mode)
    port.send(b"x", (port.host, port.port))
    found = waiting.next(5.0)
    assert found is not None
    assert (found[0], found[1].data) == (0, b"x")


@pytest.mark.parametrize("mode", get_args(Wait))
def test_a_rehearsal_comes_before_the_packet_when_polling(port: Port, mode: Wait) -> None:
    import time

    prediction = Prediction()
    waiting = Waiting([port], [prediction], mode)
    waiting.rehearse = lambda index: bool(port.send(b"from the rehearsal", (port.host, port.port)))  # type: ignore[assignment]
    prediction.add(time.monotonic_ns(), 1, 0.005)
    arrival = waiting.next(0.02)
    assert (arrival is None) == (mode == "block")


@pytest.mark.parametrize("mode", get_args(Wait))
def test_nothing_comes(port: Port, mode: Wait) -> None:
    assert Waiting([port], [Prediction()], mode).next(0.001) is None


@pytest.fixture
def other() -> Iterator[Port]:
    port = Port("127.0.0.1", 0)
    yield port
    port.close()


def test_a_socket_that_was_bound_again_is_waited_for(port: Port, other: Port, tmp_path: Path) -> None:
    """The descriptor that it had belongs to another file, which always seems to have something."""
    waiting = Waiting([port], [Prediction()], "block")
    assert waiting.next(0.0) is None
    number = port.fileno()
    os.close(number)
    taken = os.open(tmp_path / "other", os.O_CREAT | os.O_RDONLY)
    assert taken == number
    before = time.monotonic()
    assert waiting.next(0.2) is None
    assert time.monotonic() - before > 0.19
    other.send(b"x", (port.host, port.port))
    assert waiting.next(5.0) is not None
    os.close(taken)


@pytest.mark.parametrize("mode", get_args(Wait))
def test_two_ports_take_turns(port: Port, other: Port, mode: Wait) -> None:
    """A flood on one does not shut out the other."""
    waiting = Waiting([port, other], [Prediction(), Prediction()], mode)
    for _ in range(20):
        port.send(b"flood", (port.host, port.port))
    other.send(b"packet", (other.host, other.port))
    found = [waiting.next(5.0) for _ in range(3)]
    assert [(one[0], one[1].data) for one in found if one is not None][:2] in (
        [(0, b"flood"), (1, b"packet")],
        [(1, b"packet"), (0, b"flood")],
    )


def test_each_port_is_rehearsed_and_none_twice(port: Port, other: Port) -> None:
    import time

    predictions = [Prediction(), Prediction()]
    now = time.monotonic_ns()
    predictions[0].add(now, 1, 0.02)
    predictions[1].add(now, 1, 0.06)
    waiting = Waiting([port, other], predictions, "ahead")
    rehearsed: list[int] = []
    waiting.rehearse = rehearsed.append
    assert waiting.next(0.1) is None
    assert rehearsed == [0, 1]


def test_a_packet_of_another_arm_ends_the_sleep(port: Port, other: Port) -> None:
    import threading
    import time

    prediction = Prediction()
    prediction.add(time.monotonic_ns(), 1, 0.4)
    waiting = Waiting([port, other], [prediction, Prediction()], "ahead")
    threading.Timer(0.02, lambda: port.send(b"x", (other.host, other.port))).start()
    began = time.monotonic()
    found = waiting.next(5.0)
    assert found is not None
    assert found[0] == 1
    assert time.monotonic() - began < 0.3
