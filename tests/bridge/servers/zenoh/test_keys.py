"""Names and attachments on Zenoh, byte by byte."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from armlab import robots
from armlab.bridge.servers.messages import text_message
from armlab.bridge.servers.row import RowField, RowSchema
from armlab.bridge.servers.status import Status
from armlab.bridge.servers.zenoh.keys import COMMANDS, EVERY, Attached, key, robot_of
from armlab.bridge.servers.zenoh.messages import About, read_about, read_message
from armlab.bridge.servers.zenoh.security import Security
from armlab.bridge.servers.zenoh.session import (
    LAB,
    PORT,
    Address,
    BlockingPublisher,
    Publisher,
    close_session,
    open_session,
)
from armlab.errors import ArmlabError, CommandRefused, ConfigError, LinkError
from armlab.robots import to_toml

from .conftest import free_port, until


def test_names() -> None:
    assert key("lab1", "yumi_left", "state") == "armlab/lab1/yumi_left/state"
    assert key("lab1", EVERY, "alive") == "armlab/lab1/*/alive"
    assert robot_of("armlab/lab1/yumi_left/param/gain") == ("lab1", "yumi_left")
    assert COMMANDS == {"position": "q", "velocity": "qd", "effort": "tau", "motion": "q qd"}


def test_golden_attachment() -> None:
    one = Attached(bytes(range(16)), 1, -2)
    assert one.pack().hex() == "000102030405060708090a0b0c0d0e0f0100000000000000feffffffffffffff"
    assert one.client == "000102030405060708090a0b0c0d0e0f"
    assert Attached(b"labpc-" + b"A" * 10, 1, 0).client != Attached(b"labpc-" + b"B" * 10, 1, 0).client


@given(st.binary(max_size=80))
def test_attachments_are_read_or_refused(data: bytes) -> None:
    if len(data) == 32:
        assert Attached.read(data) == Attached(data[:16], *struct.unpack("<qq", data[16:]))
        assert Attached.read(data).pack() == data
    else:
        with pytest.raises(CommandRefused, match=f"got {len(data)} bytes"):
            Attached.read(data)


def test_no_attachment() -> None:
    with pytest.raises(CommandRefused, match="got none"):
        Attached.read(None)


def test_urls(tmp_path: Path) -> None:
    (tmp_path / "lab.pem").write_text("")
    assert Address.read("zenoh://host") == Address("host", PORT, LAB)
    assert Address.read("zenoh://host:1/a") == Address("host", 1, "a", Security())
    assert Address.read(f"zenoh://host/a?ca={tmp_path}/lab.pem").security == Security(ca=tmp_path / "lab.pem")
    for url in ("http://host", "zenoh://", "zenoh://host/a/b", "zenoh://host/*", "zenoh://host:x", "zenoh"):
        with pytest.raises(ConfigError, match="Expected a place like"):
            Address.read(url)
    with pytest.raises(ConfigError, match="Invalid IPv6"):
        Address.read("zenoh://[::1/a")
    with pytest.raises(ConfigError, match="only ca and secret"):
        Address.read("zenoh://host?seed=1")
    with pytest.raises(ConfigError, match="there is none"):
        Address.read(f"zenoh://host?secret={tmp_path}/none")


def test_nobody_there() -> None:
    with pytest.raises(LinkError, match="See whether it runs"):
        Address("127.0.0.1", free_port()).open(0.3)
    with pytest.raises(LinkError, match="Expected a Zenoh router"):
        Address(port=free_port()).open_behind(0.2)


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


def test_nothing_is_sent_to_nobody_and_a_waiting_output_counts_what_found_no_room() -> None:
    port = free_port()
    router = open_session("router", [f"127.0.0.1:{port}"])
    reader = open_session("peer", ["127.0.0.1:0"], [f"127.0.0.1:{port}"])
    seen: list[int] = []
    outputs = [Publisher(router, "a", lambda: seen.append(len(seen))), BlockingPublisher(router, "b")]
    for one in outputs:
        one.put(b"nobody")
        assert (one.wanted, one.sent, one.dropped) == (False, 0, 0)
    samples: list[Any] = []
    subscribers = [reader.declare_subscriber(name, samples.append) for name in "ab"]
    until(lambda: all(one.wanted for one in outputs) and seen == [0])
    for one in outputs:
        one.put(b"1", b"attached")
    until(lambda: len(samples) == 2)
    assert [one.attachment.to_bytes() for one in samples] == [b"attached", b"attached"]
    assert [one.sent for one in outputs] == [1, 1]
    for one in subscribers:
        one.undeclare()
    until(lambda: not any(one.wanted for one in outputs) and seen == [0, 1])
    waiting = outputs[1]
    assert isinstance(waiting, BlockingPublisher)
    waiting.close()
    waiting.wanted = True
    for _ in range(2501):
        waiting.put(b"2")
    assert (waiting.sent, waiting.dropped) == (1, 1)
    close_session(reader)
    close_session(router)
