"""Rows on the wire: order of the joints, what is not given, and types of other clients."""

from __future__ import annotations

import math
import socket
from collections.abc import Iterator
from typing import Any, get_args

import numpy as np
import pytest

from armlab import robots
from armlab.bridge.servers.labcomm.connection import QUEUE, Peer
from armlab.bridge.servers.labcomm.rows import STOP, Order, Row, RowTypes, signed
from armlab.errors import ConfigError, LabCommError
from armlab.wire.labcomm import Decoder, Encoder, Sample, parse_lc
from armlab.wire.labcomm.types import VOID, SampleType, Version

CHAIN = np.array([1.0, 2.0, 7.0, 3.0, 4.0, 5.0, 6.0])  # number of each joint from base to tool


def command(**parts: Any) -> dict[str, Any]:
    return {"tm": 5, "pos": [0.5] * 7, "vel": [0.0] * 7, "trq": [math.nan] * 7, **parts}


def test_the_wire_has_the_order_of_abb() -> None:
    types = RowTypes(robots.load("yumi_right").abb_axes)
    value = types.value(Row(1, CHAIN))
    assert value["pos"] == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]
    assert np.isnan(value["vel"]).all()
    assert np.array_equal(types.row(value).q, CHAIN)
    assert RowTypes(order="chain").value(Row(1, CHAIN))["pos"] == CHAIN.tolist()
    assert get_args(Order) == ("abb", "chain")


@pytest.mark.parametrize("tm", [0, 2**31 - 1, 2**31, 2**32 - 1, 2**40 + 3])
def test_time_stamps_wrap(tm: int) -> None:
    assert -(2**31) <= signed(tm) < 2**31
    assert (signed(tm) - tm) % 2**32 == 0


def test_zeros_and_nan_ask_for_nothing() -> None:
    row = RowTypes().command(command())
    assert (row.tm, row.qd, row.tau) == (5, None, None)
    assert row.q.tolist() == [0.5] * 7
    row = RowTypes().command(command(vel=[0.1] + [math.nan] * 6))
    assert row.qd.tolist() == [0.1] + [0.0] * 6


@pytest.mark.parametrize(
    "parts",
    [{"pos": [math.nan] * 7}, {"pos": [math.inf] + [0.0] * 6}, {"vel": [math.inf] + [0.0] * 6}, {"pos": [0.0] * 6}],
)
def test_commands_that_are_refused(parts: dict[str, Any]) -> None:
    with pytest.raises(LabCommError, match=r"^Expected .*\.$"):
        RowTypes().command(command(**parts))


@pytest.mark.parametrize("wrong", [np.zeros(6), np.zeros(14), np.zeros((7, 1)), np.float64(0.0)])
def test_a_row_of_another_number_of_joints_is_not_sent(wrong: np.ndarray) -> None:
    """Fourteen numbers, of two arms, must not become a command of seven."""
    with pytest.raises(LabCommError, match=r"Expected 7 numbers in pos of a row, got shape"):
        RowTypes().value(Row(1, wrong))
    with pytest.raises(LabCommError, match=r"Expected 7 numbers in vel of a row, got shape"):
        RowTypes().value(Row(1, np.zeros(7), wrong))


def test_a_refusal_shows_the_numbers_as_they_came() -> None:
    vel = [0.0] * 6 + [math.inf]
    with pytest.raises(LabCommError, match=r"in vel of a command, got \[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, inf\]"):
        RowTypes().command(command(vel=vel))


def test_rows_are_the_samples_of_the_type_that_is_sent() -> None:
    """By name and type, which the stream of each client defines anew."""
    types, (other,) = RowTypes(), parse_lc("sample struct { int tm; double pos[7]; } robot_row;")
    assert isinstance(other, SampleType)
    named = SampleType("state", types.sent.type)
    value = types.value(Row(7, CHAIN, -CHAIN))
    for _ in range(2):
        encoder, decoder = Encoder(), Decoder()
        definitions = [encoder.define(sample) for sample in (types.sent, named, other)]
        decoder.feed(encoder.version() + b"".join(definitions))
        assert types.rows(decoder.feed(encoder.data(named, value))) == []
        (row,) = types.rows(decoder.feed(encoder.data(types.sent, value) + encoder.data(named, value)))
        assert (row.tm, row.q.tolist(), row.qd.tolist()) == (7, CHAIN.tolist(), (-CHAIN).tolist())
        assert types.rows(decoder.feed(encoder.data(other, {"tm": 7, "pos": value["pos"]}))) == []
        definition = decoder.samples[0x41]
        assert types.rows([Sample(0x41, "state", value, definition.type)]) == []
        assert types.rows([Sample(0x41, "robot_row", value, VOID)]) == []


def test_accepted_types_are_the_command_row_or_less_of_it() -> None:
    types = RowTypes()
    for text, fits in (
        ("struct { int tm; double pos[7]; double vel[7]; double trq[7]; } command_row", True),
        ("struct { int tm; double pos[7]; double vel[7]; } command_row", True),
        ("struct { int tm; double vel[7]; } command_row", False),
        ("struct { int tm; double pos[7]; int more; } command_row", False),
        ("struct { int tm; float pos[7]; } command_row", False),
        ("struct { int tm; double pos[7]; } robot_row", False),
        ("double command_row", False),
    ):
        (sample,) = parse_lc(f"sample {text};")
        assert isinstance(sample, SampleType)
        assert types.accepts(sample) is fits, text


def test_an_lc_file_replaces_the_types() -> None:
    types = RowTypes(text="sample struct { long tm; float pos[_]; } state; sample struct { double pos[7]; } ask;")
    assert (types.sent.name, types.accepted.name) == ("state", "ask")
    assert types.value(Row(7, CHAIN)) == {"tm": 7, "pos": [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]}
    assert types.command({"pos": [0.0] * 7}).tm == 0
    for text in ("", "sample int a;", "sample struct { int tm; } a;", "sample struct { double pos[6]; } a;"):
        with pytest.raises(LabCommError, match="Expected"):
            RowTypes(text=text)


def test_arms_of_six_joints() -> None:
    types = RowTypes(range(1, 7))
    assert types.n == 6
    assert len(types.value(Row(0, np.zeros(6)))["pos"]) == 6
    for axes, order in (((1, 2, 2), "abb"), ((1, 2), "kinematic")):
        with pytest.raises(ConfigError, match="axis numbers"):
            RowTypes(axes, order)  # type: ignore[arg-type]


def test_stop_has_no_value() -> None:
    """Every dialect can say it."""
    assert (STOP.name, STOP.type.fixed_size) == ("stop", 0)
    for dialect in ("2014v1", "2014", "2014i", "2013", "2006"):
        encoder, decoder = Encoder(dialect), Decoder()
        events = decoder.feed(encoder.version() + encoder.define(STOP) + encoder.data(STOP, {}))
        assert (events[-1].name, events[-1].type) == (STOP.name, STOP.type)  # type: ignore[union-attr]


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
