"""How each port handles client data, rows on the wire, and the queue of a connection."""

from __future__ import annotations

import contextlib
import math
import random
import socket
from collections.abc import Iterator, Sequence
from typing import Any, get_args

import numpy as np
import pytest

from armlab import robots
from armlab.bridge.servers.labcomm.channels import (
    QUEUE,
    ArmChannel,
    FusedArm,
    FusedChannel,
    FusedSource,
    OnSet,
    ParameterChannel,
    Peer,
)
from armlab.bridge.servers.labcomm.rows import Order, Row, RowTypes, signed
from armlab.errors import ConfigError, LabCommError
from armlab.wire.labcomm import Decoder, Encoder, Sample, idl, parse_lc
from armlab.wire.labcomm.types import PRIMS, VOID, Array, Definition, SampleType, Unknown, Version

COMMAND = idl.samples("armlab")["command_row"]
VALUE = {"tm": 1, "pos": [0.5] * 7, "vel": [0.0] * 7, "trq": [0.0] * 7}


class Fake:
    def __init__(self, name: str = "a") -> None:
        self.encoder, self.address, self.sent = Encoder(), name, b""

    def push(self, packet: bytes, may_drop: bool = True) -> None:
        self.sent += packet

    def events(self) -> list[Any]:
        return Decoder().feed(self.sent)


def sample(value: Any = VALUE, node: Any = COMMAND.type, name: str = "command_row") -> Sample:
    return Sample(0x40, name, value, node)


def fakes(*names: str) -> Sequence[Any]:
    return [Fake(name) for name in names]


def test_valid_commands_are_passed_on_and_what_is_none_is_counted() -> None:
    taken: list[tuple[str, int, str]] = []
    gone: list[str] = []

    def keep(name: str, row: Row, client: str) -> None:
        taken.append((name, row.tm, client))

    channel, (a, b) = ArmChannel("left", 0, keep, on_left=gone.append), fakes("a", "b")
    for peer in (a, b, a):
        channel.take(peer, sample(), [a, b])
    channel.left(b)
    with pytest.raises(LabCommError, match="finite"):
        channel.take(a, sample({**VALUE, "pos": [np.nan] * 7}), [a])
    with pytest.raises(LabCommError, match="Expected command_row on this port, got a sample of type"):
        channel.take(a, sample(3, PRIMS["int"]), [a])
    for event in (Version("x"), Definition("sample", 0x40, "command_row", COMMAND.type), Unknown(0x41, b"")):
        channel.take(a, event, [a])
    assert taken == [("left", 1, "a"), ("left", 1, "b"), ("left", 1, "a")]
    assert gone == ["b"]
    assert channel.counts == {"commands": 3, "refused": 1, "other type": 1}


def test_fused_rows() -> None:
    channel, (a,) = FusedChannel(), fakes("a")
    channel.greet(a)
    row = Row(4, np.arange(7.0))
    channel.put((9, [FusedArm("left", 8, row)], [FusedSource("force_left", 7, [1.0, 2.0])]), [a])
    channel.take(a, sample(), [a])
    value = a.events()[-1].value
    assert value["t_us"] == 9
    assert value["source"] == [{"name": "force_left", "t_us": 7, "value": [1.0, 2.0]}]
    assert value["arm"][0]["pos"] == [0.0, 1.0, 3.0, 4.0, 5.0, 6.0, 2.0]
    assert channel.counts == {"ignored": 1}
    with pytest.raises(ConfigError, match="7 joints"):
        FusedChannel(axes=range(1, 7))


def test_mutated_commands_are_whole_or_refused() -> None:
    rng, encoder, taken = random.Random(11), Encoder(), list[Row]()
    raw = encoder.version() + encoder.define(COMMAND) + 3 * encoder.data(COMMAND, VALUE)
    channel, (peer,) = ArmChannel("left", 0, lambda name, row, client: taken.append(row)), fakes("a")
    for _ in range(500):
        data = bytearray(raw)
        for _ in range(rng.randint(1, 3)):
            at = rng.randrange(len(data))
            data[at : at + rng.randint(0, 1)] = rng.choice((b"", b"\x00", b"\x7f", b"\xff", b"\xf0"))
        try:
            events = Decoder().feed(data)
        except LabCommError as error:
            events = error.events
        for event in events:
            with contextlib.suppress(LabCommError):
                channel.take(peer, event, [peer])
    assert len(taken) > 250
    for row in taken:
        assert row.q is not None
        assert row.q.shape == (7,)
        assert all(np.isfinite(part).all() for part in row[1:] if part is not None)


def values(peer: Fake) -> list[tuple[str, Any]]:
    return [(event.name, event.value) for event in peer.events() if isinstance(event, Sample)]


def test_parameters_are_told_to_who_asks_and_echoed_to_all_of_them() -> None:
    asked: list[Any] = []

    def on_set(name: str, value: Any, who: str) -> Any:
        asked.append((name, value, who))
        return min(value, 10.0) if name == "gain" else None

    taken: OnSet = on_set
    channel, (a, b, c) = ParameterChannel({"gain": 1.0, "damping": [1.0, 2.0]}, on_set=taken), fakes("a", "b", "c")
    everyone = [a, b, c]
    for peer in everyone:
        channel.greet(peer)
        assert len(peer.events()) == 1, "only VERSION"
    channel.take(a, Definition("sample", 0x50, "gain", PRIMS["double"]), everyone)
    channel.take(b, Definition("ref", 0x50, "gain", PRIMS["double"]), everyone)
    channel.take(b, Definition("sample", 0x51, "damping", Array((0,), PRIMS["double"])), everyone)
    channel.take(a, sample(3.0, PRIMS["double"], "gain"), everyone)
    channel.take(a, sample(99.0, PRIMS["double"], "gain"), everyone)
    channel.take(a, sample(float("nan"), PRIMS["double"], "gain"), everyone)
    channel.take(b, sample([5.0], Array((0,), PRIMS["double"]), "damping"), everyone)
    channel.put(("damping", [5.0]), everyone)
    assert values(a) == [("gain", 1.0), ("gain", 3.0), ("gain", 10.0), ("gain", 10.0)]
    assert values(b) == [
        ("gain", 1.0), ("damping", [1.0, 2.0]), ("gain", 3.0), ("gain", 10.0), ("gain", 10.0), ("damping", [5.0])
    ]  # fmt: skip
    assert values(c) == []
    assert asked == [("gain", 3.0, "a"), ("gain", 99.0, "a"), ("damping", [5.0], "b")]
    for node, name in ((PRIMS["int"], "gain"), (PRIMS["double"], "mass")):
        channel.take(a, sample(1, node, name), everyone)
        channel.take(a, Definition("sample", 0x60, name, node), everyone)
    channel.left(a)
    assert channel.counts == {"set": 1, "refused": 2, "other type": 2, "unknown": 2}


@pytest.mark.parametrize("text", ["a\0b", "a\ud800b"])
def test_a_text_that_clients_cannot_be_told_is_refused(text: str) -> None:
    channel, (a,) = ParameterChannel({"task": "grind"}), fakes("a")
    channel.greet(a)
    channel.take(a, Definition("sample", 0x50, "task", PRIMS["string"]), [a])
    channel.take(a, sample(text, PRIMS["string"], "task"), [a])
    assert values(a) == [("task", "grind"), ("task", "grind")]
    channel.take(a, sample("polish", PRIMS["string"], "task"), [a])
    assert values(a)[-1] == ("task", "polish"), "without a decision function, all other values are accepted"
    assert channel.counts == {"refused": 1, "set": 1}


CHAIN = np.array([1.0, 2.0, 7.0, 3.0, 4.0, 5.0, 6.0])  # ABB axis number of each joint, from base to tool


def test_the_wire_has_the_order_of_abb() -> None:
    types = RowTypes(robots.load("yumi_right").abb_axes)
    value = types.value(Row(1, CHAIN))
    assert value["pos"] == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]
    assert np.isnan(value["vel"]).all()
    assert np.array_equal(types.row(value).q, CHAIN)
    assert RowTypes(order="chain").value(Row(1, CHAIN))["pos"] == CHAIN.tolist()
    assert get_args(Order) == ("abb", "chain")


def test_time_stamps_wrap() -> None:
    assert [signed(tm) for tm in (0, 2**31 - 1, 2**31, 2**32 - 1, 2**40 + 3)] == [0, 2**31 - 1, -(2**31), -1, 3]


def test_zeros_and_nan_ask_for_nothing() -> None:
    types, value = RowTypes(), {"tm": 5, "pos": [0.5] * 7, "vel": [0.0] * 7, "trq": [math.nan] * 7}
    row = types.command(value)
    assert (row.tm, row.q.tolist(), row.qd, row.tau) == (5, [0.5] * 7, None, None)
    row = types.command({**value, "vel": [0.1] + [math.nan] * 6})
    assert row.qd.tolist() == [0.1] + [0.0] * 6
    far = [math.inf] + [0.0] * 6
    for parts in ({"pos": [math.nan] * 7}, {"pos": far}, {"vel": far}, {"pos": [0.0] * 6}):
        with pytest.raises(LabCommError, match=r"^Expected .*\.$"):
            types.command({**value, **parts})


@pytest.mark.parametrize("wrong", [np.zeros(6), np.zeros(14), np.zeros((7, 1)), np.float64(0.0)])
def test_a_row_of_another_number_of_joints_is_not_sent(wrong: np.ndarray) -> None:
    """Fourteen numbers for two arms must not become a command of seven numbers."""
    with pytest.raises(LabCommError, match=r"Expected 7 numbers in pos of a row, got shape"):
        RowTypes().value(Row(1, wrong))
    with pytest.raises(LabCommError, match=r"Expected 7 numbers in vel of a row, got shape"):
        RowTypes().value(Row(1, np.zeros(7), wrong))


def test_rows_are_the_samples_of_the_type_that_is_sent() -> None:
    types, (other,) = RowTypes(), parse_lc("sample struct { int tm; double pos[7]; } robot_row;")
    value = types.value(Row(7, CHAIN, -CHAIN))
    (row,) = types.rows([Sample(0x50, "robot_row", value, types.sent.type)])
    assert (row.tm, row.q.tolist(), row.qd.tolist()) == (7, CHAIN.tolist(), (-CHAIN).tolist())
    for name, node in (("state", types.sent.type), ("robot_row", other.type), ("robot_row", VOID)):
        assert types.rows([Sample(0x40, name, value, node)]) == []


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


@pytest.fixture
def pair() -> Iterator[tuple[Peer, socket.socket]]:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        other = socket.create_connection(listener.getsockname(), timeout=10.0)
        ours, _ = listener.accept()
    with ours, other:
        yield Peer(ours, "test", Encoder()), other


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
    assert other.makefile("rb").read(len(expected)) == expected


def test_newer_data_replaces_what_waits(pair: tuple[Peer, socket.socket]) -> None:
    peer, other = pair
    peer.push(b"DEF", may_drop=False)
    peer.push(b"old")
    peer.clear()
    peer.push(b"new")
    assert peer.flush()
    assert peer.dropped == 1
    assert other.makefile("rb").read(6) == b"DEFnew"


def test_a_peer_that_takes_nothing_is_overdue(pair: tuple[Peer, socket.socket]) -> None:
    peer, other = pair
    for _ in range(200):
        peer.push(bytes(60_000))
        assert peer.flush()
    assert peer.dropped > 0
    assert peer.is_stuck
    assert peer.overdue(peer.began + 1.0) == ""
    assert "read nothing" in peer.overdue(peer.began + 60.0)
    other.close()
    while peer.flush():
        pass  # the system reports the end of the connection at one of the next writes


def test_a_packet_that_stays_incomplete_is_overdue(pair: tuple[Peer, socket.socket]) -> None:
    peer, other = pair
    assert peer.overdue(peer.began + 60.0) == "", "a silent peer is not a fault"
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
