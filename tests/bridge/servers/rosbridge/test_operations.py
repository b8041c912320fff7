"""Operations as clients write them."""

from __future__ import annotations

import json
from typing import get_args

import pytest

from armlab.bridge.servers.rosbridge.operations import (
    LARGEST,
    Advertise,
    CallService,
    Level,
    Operation,
    Publish,
    ServiceResponse,
    SetLevel,
    Status,
    Subscribe,
    Unadvertise,
    Unsubscribe,
    full_name,
    id_of,
    read_operation,
)
from armlab.errors import CommandRefused

GOLDEN: dict[str, Operation] = {
    '{"op":"subscribe","id":"s:1","type":"a/B","topic":"/a","compression":"none","throttle_rate":5,"queue_length":2}': (
        Subscribe(id="s:1", topic="/a", type="a/B", compression="none", throttle_rate=5.0, queue_length=2)
    ),
    '{"op":"subscribe","topic":"/a","throttle_rate":null,"queue_length":null,"type":null,"more":[{}]}': (
        Subscribe(topic="/a", throttle_rate=None, queue_length=None)
    ),
    '{"op":"unsubscribe","id":3,"topic":"/a"}': Unsubscribe(id=3, topic="/a"),
    '{"op":"advertise","type":"a/B","topic":"/a","latch":false,"queue_size":100}': Advertise(topic="/a", type="a/B"),
    '{"op":"unadvertise","topic":"/a"}': Unadvertise(topic="/a"),
    '{"op":"publish","topic":"/a","msg":{"data":[1]},"latch":false}': Publish(topic="/a", msg={"data": [1]}),
    '{"topic":"/a","op":"publish"}': Publish(topic="/a", msg={}),
    '{"op":"call_service","id":"c","service":"/s","args":[1]}': CallService(id="c", service="/s", args=[1]),
    '{"op":"service_response","service":"/s","values":{},"result":true}': ServiceResponse(service="/s"),
    '{"op":"set_level","level":"warning"}': SetLevel(level="warning"),
    '{"op":"status","level":"error","msg":"a"}': Status(),
}


@pytest.mark.parametrize(("text", "operation"), GOLDEN.items())
def test_golden_operations(text: str, operation: Operation) -> None:
    assert read_operation(text) == operation
    assert id_of(text) == operation.id


def test_levels() -> None:
    for level in get_args(Level):
        assert read_operation(json.dumps({"op": "set_level", "level": level})) == SetLevel(level=level)


def test_a_missing_leading_slash_is_added() -> None:
    assert full_name("a/b") == full_name("/a/b") == "/a/b"
    assert full_name("//a") == "//a", "no other spelling is understood"


def test_too_long_and_ids_that_are_none() -> None:
    with pytest.raises(CommandRefused, match="at most 65536 characters"):
        read_operation(" " * (LARGEST + 1))
    assert id_of('{"id": [1], "op": 3}') is None
    assert id_of(json.dumps({"id": "x" * 1000})) == "x" * 256
    assert id_of(b"\xff") is None
