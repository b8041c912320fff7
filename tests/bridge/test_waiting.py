"""Prediction of arrivals, and the three ways of waiting."""

from __future__ import annotations

from collections.abc import Iterator
from typing import get_args

import pytest

from armlab.bridge.port import Port
from armlab.bridge.waiting import Prediction, Wait, Waiting

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
    waiting = Waiting(port, mode)
    port.send(b"x", (port.host, port.port))
    assert port.wait(5.0)
    arrival = waiting.next(5.0)
    assert arrival is not None
    assert arrival.data == b"x"


@pytest.mark.parametrize("mode", get_args(Wait))
def test_a_rehearsal_comes_before_the_packet_when_polling(port: Port, mode: Wait) -> None:
    import time

    waiting = Waiting(port, mode)
    waiting.rehearse = lambda: bool(port.send(b"from the rehearsal", (port.host, port.port)))  # type: ignore[assignment]
    waiting.prediction.add(time.monotonic_ns(), 1, 0.005)
    arrival = waiting.next(0.02)
    assert (arrival is None) == (mode == "block")


@pytest.mark.parametrize("mode", get_args(Wait))
def test_nothing_comes(port: Port, mode: Wait) -> None:
    assert Waiting(port, mode).next(0.001) is None
