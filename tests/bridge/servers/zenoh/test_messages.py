"""What bridges say over Zenoh is taken as they say it, or refused by a sentence."""

from __future__ import annotations

import json
from typing import Any

import pytest

from armlab import robots
from armlab.bridge.servers.messages import text_message
from armlab.bridge.servers.row import RowField, RowSchema
from armlab.bridge.servers.status import Status
from armlab.bridge.servers.zenoh.messages import About, read_about, read_message
from armlab.errors import ArmlabError, LinkError
from armlab.robots import to_toml

ARM = robots.load("ur5e")
SCHEMA = RowSchema.of([ARM])


def about(**changed: Any) -> dict[str, Any]:
    said = {"kind": "about", "run": "a", "cell": "c", "schema": SCHEMA.text.decode(), "robots": {"ur5e": to_toml(ARM)}}
    return {**said, **changed}


def test_what_a_bridge_says() -> None:
    parameters = {"kind": "parameters", "parameters": [{"name": "gain", "value": 0.5}]}
    found = read_about(json.dumps([about(), parameters]).encode())
    assert isinstance(found, About)
    assert found.said == [about(), parameters]
    assert (found.run, found.cell, found.schema.id, found.robots["ur5e"].hash) == ("a", "c", SCHEMA.id, ARM.hash)
    for text in (
        text_message("event", stamp_ns=1, text="Hello.", warn=False),
        text_message("recording", files=["a.mcap"]),
        text_message("status", **Status(SCHEMA).summary()),
        json.dumps(parameters).encode(),
    ):
        assert read_message(text) == json.loads(text)


def test_a_few_fields_of_an_arm_are_enough_and_others_are_refused() -> None:
    fields = [RowField("ur5e.q", "float64", (6,), "rad", "", (), "ur5e", 40)]
    some = RowSchema(["ur5e"], fields).text.decode()
    assert read_about(json.dumps([about(schema=some)]).encode()).schema.size == 88
    with pytest.raises(LinkError, match=r"Expected rows with ur5e.q"):
        read_about(json.dumps([about(schema=some.replace("[6]", "[5]"))]).encode())
    fields.append(RowField("b.commander", "text", (8,), "1", "", (), "b", 88))
    with pytest.raises(LinkError, match=r"only commanders of arms are texts, got b.commander"):
        read_about(json.dumps([about(schema=RowSchema(["ur5e"], fields).text.decode())]).encode())


@pytest.mark.parametrize(
    "said",
    [
        [], [1], {}, [about(schema="{}")], [about(schema=1)], [about(robots={})], [about(robots={"ur5e": "x"})],
        [about(robots={"ur5e": to_toml(ARM), "other": to_toml(ARM)})], [about(run=[])], [about(), about()],
        [about(), {"kind": "event"}], [about(), {}], [about(note="x" * 2**19)],
    ],
)  # fmt: skip
def test_answers_that_are_none(said: Any) -> None:
    with pytest.raises(ArmlabError, match=r"^Expected"):
        read_about(json.dumps(said).encode())


@pytest.mark.parametrize(
    "data",
    [
        b"", b"[1", b"5", b"{}", b"[" * 100_000, b"\xff", b'"event"', b'{"kind": []}', b'{"kind": "about"}',
        b'{"kind": "event", "text": "a"}', b'{"kind": "event", "text": "a", "stamp_ns": 1%s}' % (b"0" * 400),
        b'{"kind": "recording", "files": [5]}', b'{"kind": "parameters", "parameters": {}}',
        b'{"kind": "status", "arms": {"a": {"rate": 1%s}}}' % (b"0" * 400),
        b'{"kind": "status", "arms": {"a": {"missed": Infinity}}}', b'{"kind": "status", "arms": {"a": {"clamps": 1}}}',
        b'{"kind": "event", "stamp_ns": 1, "text": "%s"}' % (b"x" * 2**17),
    ],
)  # fmt: skip
def test_texts_that_are_none(data: bytes) -> None:
    with pytest.raises(LinkError, match=r"^Expected a text of a bridge"):
        read_message(data)
