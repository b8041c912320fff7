"""Messages between loop and servers."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armlab.bridge.inputs.parameters import Parameter, Parameters
from armlab.bridge.servers.messages import (
    CommandRequest,
    Counted,
    Leave,
    Listening,
    Release,
    Report,
    Request,
    Resume,
    SetRequest,
    Stop,
    Subscribe,
    parameter_message,
    read_request,
    text_message,
)
from armlab.errors import LinkError


@pytest.mark.parametrize(
    ("text", "request_"),
    [
        (b'{"kind":"stop","client":"a"}', Stop("a")),
        (b'{"kind":"resume"}', Resume()),
        (b'{"kind":"release"}', Release()),
        (b'{"kind":"leave","client":"a"}', Leave("a")),
        (b'{"kind":"report","client":"a","text":"no"}', Report("a", "no")),
        (b'{"kind":"listening","where":["x"]}', Listening(where=["x"])),
        (b'{"kind":"subscribe","rate":null}', Subscribe(rate=None)),
        (b'{"kind":"counted","clients":{"a":[7,2]}}', Counted(clients={"a": (7, 2)})),
        (b'{"kind":"set","client":"a","values":{"gain":2.5}}', SetRequest("a", {"gain": 2.5})),
        (b'{"kind":"command","client":"a","arm":"b","q":[1,null]}', CommandRequest("a", "b", [1.0, None])),
    ],
)
def test_requests(text: bytes, request_: Request) -> None:
    assert read_request(text) == request_


@pytest.mark.parametrize(
    "data",
    [b"", b"1", b'{"kind":"go"}', b'{"kind":"stop","x":1}', b'{"kind":"set","values":[]}', b"[" * 60000, b" " * 70000],
)
def test_what_is_no_request(data: bytes) -> None:
    with pytest.raises(LinkError, match="Expected a request"):
        read_request(data)


@given(st.binary(max_size=100))
def test_noise(data: bytes) -> None:
    for text in (data, b'{"kind":"set","values":{"a":' + data + b"}}", b'{"kind":"command","q":[' + data + b"]}"):
        try:
            found = read_request(text)
        except LinkError:
            continue
        assert isinstance(found, Request)


def test_texts() -> None:
    data = text_message("status", late=np.int64(3), q=np.array([1.0, np.nan]))
    assert json.loads(data) == {"kind": "status", "late": 3, "q": [1.0, None]}


def test_parameters() -> None:
    parameters = Parameters([Parameter("gain", 2.0, minimum=0.0), Parameter("f", [1.0, 2.0], "float[2]")])
    parameters.set("gain", 3.0, "a")
    parameters.apply()
    gain, force = json.loads(parameter_message(parameters))["parameters"]
    assert (gain["value"], gain["default"], gain["who"], gain["sequence"], gain["maximum"]) == (3.0, 2.0, "a", 1, None)
    assert (force["value"], force["who"]) == ([1.0, 2.0], "")


def test_a_command_is_no_longer_than_any_arm() -> None:
    assert read_request(json.dumps({"kind": "command", "q": [0.0] * 64}).encode()) == CommandRequest(q=[0.0] * 64)
    with pytest.raises(LinkError, match=r"Expected a request in JSON, but .*length <= 64"):
        read_request(json.dumps({"kind": "command", "q": [0.0] * 65}).encode())
