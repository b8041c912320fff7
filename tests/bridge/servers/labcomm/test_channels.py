"""What each port does with what clients send. No sockets."""

from __future__ import annotations

import contextlib
import random
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pytest

from armlab.bridge.servers.labcomm.channels import (
    ArmChannel,
    Channel,
    FusedArm,
    FusedChannel,
    FusedSource,
    OnCommand,
)
from armlab.bridge.servers.labcomm.rows import Row
from armlab.errors import ConfigError, LabCommError, UnknownName
from armlab.wire.labcomm import Decoder, Encoder, Sample, idl
from armlab.wire.labcomm.types import PRIMS, Definition, Unknown, Version

COMMAND = idl.samples("armlab")["command_row"]
VALUE = {"tm": 1, "pos": [0.5] * 7, "vel": [0.0] * 7, "trq": [0.0] * 7}


class Fake:
    """A peer that keeps what it is sent."""

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


def test_every_valid_command_is_passed_on() -> None:
    """Who may command is decided in one place, which is not here."""
    taken, gone = [], []
    on_command: OnCommand = lambda name, row, client: taken.append((name, row.tm, client))  # noqa: E731
    channel, (a, b) = ArmChannel("left", 0, on_command, on_left=gone.append), fakes("a", "b")
    for peer in (a, b, a):
        channel.take(peer, sample(), [a, b])
    channel.left(b)
    assert taken == [("left", 1, "a"), ("left", 1, "b"), ("left", 1, "a")]
    assert gone == ["b"]
    assert channel.counts == {"commands": 3}


def test_what_is_no_command_is_counted() -> None:
    taken: list[Any] = []
    channel, (a,) = ArmChannel("left", 0, lambda *args: taken.append(args)), fakes("a")
    with pytest.raises(LabCommError, match="finite"):
        channel.take(a, sample({**VALUE, "pos": [np.nan] * 7}), [a])
    with pytest.raises(LabCommError, match="Expected command_row on this port, got a sample"):
        channel.take(a, sample(3, PRIMS["int"]), [a])
    for event in (Version("x"), Definition("sample", 0x40, "command_row", COMMAND.type), Unknown(0x41, b"")):
        channel.take(a, event, [a])
    assert (taken, channel.counts) == ([], {"refused": 1, "other type": 1})


def test_a_row_is_sent_in_the_dialect_of_each_client() -> None:
    channel, (a, b) = ArmChannel("left", 0), fakes("a", "b")
    b.encoder = Encoder("2006")
    for peer in (a, b):
        channel.greet(peer)
    channel.put(Row(7, np.zeros(7)), [a, b])
    assert [type(event) for event in a.events()] == [Version, Definition, Sample]
    assert [type(event) for event in b.events()] == [Definition, Sample]
    assert b.events()[-1].value["tm"] == 7


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


def test_ports_in_general() -> None:
    with pytest.raises(UnknownName):
        Channel("x", 0, dialect="2015")
    with pytest.raises(NotImplementedError):
        Channel("x", 0).put(None, [])


def mutants(count: int) -> Iterator[bytes]:
    rng, encoder = random.Random(11), Encoder()
    raw = encoder.version() + encoder.define(COMMAND) + 3 * encoder.data(COMMAND, VALUE)
    for _ in range(count):
        data = bytearray(raw)
        for _ in range(rng.randint(1, 3)):
            at = rng.randrange(len(data))
            if rng.random() < 0.2:
                del data[at : at + rng.randint(1, 4)]
            else:
                data[at] = rng.choice((0x00, 0x7F, 0xFF, 0xF0, rng.randrange(256)))
        yield bytes(data)


def obeyed(count: int) -> list[Row]:
    """What an arm would be asked by mutated streams of commands, one client after another."""
    taken: list[Row] = []
    channel = ArmChannel("left", 0, lambda name, row, client: taken.append(row))
    for raw in mutants(count):
        (peer,), decoder = fakes("a"), Decoder()
        try:
            events = decoder.feed(raw)
        except LabCommError as error:
            events = error.events
        for event in events:
            with contextlib.suppress(LabCommError):
                channel.take(peer, event, [peer])
        channel.left(peer)
    return taken


@pytest.mark.parametrize("count", [1000, pytest.param(50_000, marks=pytest.mark.slow)])
def test_mutated_commands_are_whole_or_refused(count: int) -> None:
    """Each command that reaches the loop is finite and of the right length. The slow one takes about 15 s."""
    rows = obeyed(count)
    assert len(rows) > count // 2
    for row in rows:
        assert row.q is not None
        assert row.q.shape == (7,)
        assert np.isfinite(row.q).all()
        for part in (row.qd, row.tau):
            assert part is None or np.isfinite(part).all()
