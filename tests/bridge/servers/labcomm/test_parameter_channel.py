"""Parameters on their port: asked for, set, echoed, in the types of LabComm. No sockets."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest

from armlab.bridge.servers.labcomm.channels import OnSet, ParameterChannel, Value
from armlab.errors import ConfigError
from armlab.wire.labcomm import Decoder, Encoder, Sample
from armlab.wire.labcomm.types import PRIMS, Array, Definition


class Fake:
    """A peer that keeps what it is sent."""

    def __init__(self, name: str = "a") -> None:
        self.encoder, self.address, self.sent = Encoder(), name, b""

    def push(self, packet: bytes, may_drop: bool = True) -> None:
        self.sent += packet

    def events(self) -> list[Any]:
        return Decoder().feed(self.sent)


def sample(value: Any, node: Any, name: str) -> Sample:
    return Sample(0x40, name, value, node)


def fakes(*names: str) -> Sequence[Any]:
    return [Fake(name) for name in names]


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


def test_each_value_has_the_type_it_was_asked_for_in() -> None:
    """Truth values and texts have their own types; a vector may have its size or none."""
    start: dict[str, Value] = {"gentle": True, "task": "grind", "force": [1.0, 2.0], "count": 3.0}
    channel, (a, b) = ParameterChannel(start), fakes("a", "b")
    for peer in (a, b):
        channel.greet(peer)
    three, two, any_ = (Array((n,), PRIMS["double"]) for n in (3, 2, 0))
    for name, node in (("gentle", PRIMS["boolean"]), ("task", PRIMS["string"]), ("force", two)):
        channel.take(a, Definition("sample", 0x50, name, node), [a, b])
    channel.take(b, Definition("sample", 0x50, "force", any_), [a, b])
    for name, node in (("gentle", PRIMS["double"]), ("task", any_), ("force", three)):
        channel.take(b, Definition("sample", 0x51, name, node), [a, b])
    assert channel.counts == {"other type": 3}
    for value, node, name in (
        (False, PRIMS["boolean"], "gentle"), ("deburr \u00e9", PRIMS["string"], "task"), ([3.0, 4.0], two, "force")
    ):  # fmt: skip
        channel.take(a, sample(value, node, name), [a, b])
    assert values(a)[3:] == [("gentle", False), ("task", "deburr \u00e9"), ("force", [3.0, 4.0])]
    assert values(b) == [("force", [1.0, 2.0]), ("force", [3.0, 4.0])]


@pytest.mark.parametrize("text", ["a\0b", "a\ud800b"])
def test_a_text_that_clients_cannot_be_told_is_refused(text: str) -> None:
    channel, (a,) = ParameterChannel({"task": "grind"}), fakes("a")
    channel.greet(a)
    channel.take(a, Definition("sample", 0x50, "task", PRIMS["string"]), [a])
    channel.take(a, sample(text, PRIMS["string"], "task"), [a])
    assert values(a) == [("task", "grind"), ("task", "grind")]
    assert channel.counts == {"refused": 1}
