"""What each port does with what clients send: leases, parameters, counts. No sockets."""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pytest

from armlab.bridge.labcomm import channels
from armlab.bridge.labcomm.channels import (
    ArmChannel,
    Channel,
    FusedArm,
    FusedChannel,
    FusedSource,
    OnCommand,
    OnSet,
    ParameterChannel,
)
from armlab.bridge.labcomm.rows import Row
from armlab.errors import ConfigError, LabCommError, UnknownName
from armlab.wire.labcomm import PRIMS, Array, Decoder, Definition, Encoder, Sample, Unknown, Version, idl

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


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def monotonic(self) -> float:
        return self.now


def sample(value: Any = VALUE, node: Any = COMMAND.type, name: str = "command_row") -> Sample:
    return Sample(0x40, name, value, node)


def fakes(*names: str) -> Sequence[Any]:
    return [Fake(name) for name in names]


def test_one_client_holds_the_arm(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, taken = Clock(), []
    monkeypatch.setattr(channels, "time", clock)
    on_command: OnCommand = lambda name, row, client: taken.append((name, row.tm, client))  # noqa: E731
    channel, (a, b) = ArmChannel("left", 0, on_command), fakes("a", "b")
    channel.take(a, sample(), [a, b])
    channel.take(b, sample(), [a, b])
    clock.now += 0.09
    channel.take(b, sample(), [a, b])
    assert taken == [("left", 1, "a")]
    clock.now += 0.02
    channel.take(b, sample(), [a, b])
    assert taken[-1] == ("left", 1, "b"), "silence for 100 ms frees the arm"
    channel.take(a, sample(), [a, b])
    channel.left(b)
    channel.take(a, sample(), [a, b])
    assert [client for *_, client in taken] == ["a", "b", "a"]
    assert channel.counts == {"commands": 3, "held by another client": 3}


def test_what_is_no_command_is_counted() -> None:
    taken: list[Any] = []
    channel, (a,) = ArmChannel("left", 0, lambda *args: taken.append(args)), fakes("a")
    channel.take(a, sample({**VALUE, "pos": [np.nan] * 7}), [a])
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


def test_all_parameters_on_accept() -> None:
    channel, (a,) = ParameterChannel({"gain": 1.0, "damping": [2.0]}, mode="all"), fakes("a")
    channel.greet(a)
    assert values(a) == [("gain", 1.0), ("damping", [2.0])]
    channel.take(a, sample(4.0, PRIMS["double"], "gain"), [a])
    assert values(a)[-1] == ("gain", 4.0)
    with pytest.raises(ConfigError, match="asked"):
        ParameterChannel({}, mode="none")  # type: ignore[arg-type]
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
