"""Zenoh: sessions and their end, keys and attachments byte by byte, bridge texts, queued and missing rows."""

from __future__ import annotations

import itertools
import json
import re
import socket
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armlab import robots
from armlab.bridge.servers.messages import text_message
from armlab.bridge.servers.row import LARGEST, RowField, RowSchema, RowWriter
from armlab.bridge.servers.status import Status
from armlab.bridge.servers.zenoh.messages import (
    COMMANDS,
    EVERY,
    About,
    Attachment,
    Gaps,
    Inbox,
    checksum,
    key,
    read_about,
    read_message,
    robot_of,
    undamaged,
)
from armlab.bridge.servers.zenoh.security import Security
from armlab.bridge.servers.zenoh.session import (
    LAB,
    PORT,
    BlockingPublisher,
    Discovery,
    LabAddress,
    close_session,
    open_near,
    open_session,
    queried,
    wait_for_router,
    zenoh,
)
from armlab.errors import ArmlabError, CommandRefused, ConfigError, LinkError, MissingExtra
from armlab.log import Tick
from armlab.robots import to_toml
from armlab.state import State

from ....processes import free_port
from ..conftest import until

FORGOTTEN = """
from armlab.bridge.servers.zenoh.session import open_session
session = open_session("peer", ["127.0.0.1:0"])
session.declare_subscriber("a", print)
raise SystemExit(3)
"""


def test_a_program_that_forgets_to_close_ends() -> None:
    assert subprocess.run([sys.executable, "-c", FORGOTTEN], timeout=30.0, check=False).returncode == 3


def test_what_is_too_large_is_not_put_together_and_the_next_message_comes() -> None:
    port = free_port()
    router, samples = open_session("router", [f"127.0.0.1:{port}"]), list[int]()
    reading = router.declare_subscriber("a/*", lambda sample: samples.append(len(sample.payload)))
    senders = [open_session("client", connect=[f"127.0.0.1:{port}"]) for _ in range(2)]
    block = zenoh().CongestionControl.BLOCK
    senders[0].put("a/b", bytes(10**6), congestion_control=block)
    until(lambda: samples == [10**6])
    senders[0].put("a/b", bytes(3 * 10**6), congestion_control=block)
    for size, sender in enumerate(senders, 1):
        until(lambda size=size, sender=sender: sender.put("a/b", bytes(size)) or size in samples)
    assert max(samples[1:]) == 2
    assert reading is not None


def test_answers_without_end_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("armlab.bridge.servers.zenoh.session._ANSWERS", 100)
    port = free_port()
    router, rest = open_session("router", [f"127.0.0.1:{port}"]), list[bool]()

    def answer(query: Any) -> None:
        with query:
            for number in range(50):
                query.reply(f"a/{number}", bytes(30))
        rest.append(True)

    answering = router.declare_queryable("a/*", answer)
    asker = open_session("client", connect=[f"127.0.0.1:{port}"])
    until(lambda: queried(asker, "a/*", 1.0))
    assert len(queried(asker, "a/*", 5.0)) == 3
    assert rest
    assert answering is not None


def test_commands_do_not_come_by_a_router_that_listens_at_every_address() -> None:
    port = free_port()
    everywhere = open_session("router", [f"0.0.0.0:{port}"])
    for router in ("", f"127.0.0.1:{port}"):
        with pytest.raises(
            ConfigError,
            match="a Zenoh router that listens only on this computer, "
            f"but the router at port {port} listens on every address",
        ):
            open_near("127.0.0.1", port, router, commands=True)
    reading, where = open_near("127.0.0.1", port)
    assert f"through the router at 127.0.0.1:{port}" in where
    for session in (reading, everywhere):
        close_session(session)
    open_session("router", [f"127.0.0.1:{port}"])
    open_near("127.0.0.1", port, commands=True)
    with pytest.raises(LinkError, match="another router already uses the port for connections from this computer only"):
        open_near("0.0.0.0", port)


@pytest.mark.slow
def test_a_server_with_a_router_elsewhere_is_found_at_its_own_port() -> None:
    far, own = free_port(), free_port()
    open_session("router", [f"127.0.0.1:{far}"])
    _, where = open_near("127.0.0.1", own, f"127.0.0.1:{far}")
    assert where == f"tcp/127.0.0.1:{own} (zenoh, through the router at 127.0.0.1:{far})"
    _, where = open_near("127.0.0.1", own, f"127.0.0.1:{far}")
    assert re.fullmatch(rf"tcp/127.0.0.1:[1-9]\d* \(zenoh, through the router at 127.0.0.1:{far}\)", where)
    assert f":{own} " not in where
    for address in (f"127.0.0.1:{own}", where.split()[0].removeprefix("tcp/")):
        open_session("client", connect=[address])
    _, where = open_near("127.0.0.1", 0)
    assert re.fullmatch(r"tcp/127.0.0.1:[1-9]\d* \(zenoh router\)", where)


@pytest.mark.parametrize("router", ["192.168.1.9:7447", "127.lab.example:7447"])
def test_no_commands_by_a_router_elsewhere(router: str) -> None:
    with pytest.raises(ConfigError, match="is on another computer"):
        open_near("127.0.0.1", free_port(), router, commands=True)
    with pytest.raises(ConfigError, match=r"Expected a router such as"):
        open_near("127.0.0.1", free_port(), "192.168.1.9")
    with pytest.raises(LinkError, match=r"Expected an address of this computer"):
        open_near("192.0.2.1", 0)


def test_nobody_is_found() -> None:
    session = open_session("peer", [], [f"127.0.0.1:{free_port()}"])
    assert not wait_for_router(session, 0.1)
    with pytest.raises(LinkError, match="Expected a Zenoh session"):
        open_session("peer", ["no address"])


def test_without_zenoh(monkeypatch: pytest.MonkeyPatch) -> None:
    assert zenoh().Session
    monkeypatch.setitem(sys.modules, "zenoh", None)
    with pytest.raises(MissingExtra, match=r"armlab\[net\]"):
        zenoh()


def test_the_answer_comes_and_a_question_is_not_repeated_at_once(session: Callable[..., Any]) -> None:
    port = free_port()
    router, asked = open_session("router", [f"127.0.0.1:{port}"]), []

    def answer(query: Any) -> None:
        asked.append(str(query.key_expr))
        with query:
            query.reply(query.key_expr, b"here")

    answering = router.declare_queryable("armlab/lab1/*/about", answer)
    told: list[tuple[str, str, bytes]] = []
    asking = Discovery(session(port), lambda *words: told.append(words))
    until(lambda: asking.ask("lab1", "arm") or told)  # the peers that can answer are not known immediately
    assert told[0] == ("lab1", "arm", b"here")
    before = len(asked)
    asking._due.clear()
    for _ in range(100):
        asking.ask("lab1", "other")
    until(lambda: ("lab1", "other", b"here") in told)
    assert len(asked) == before + 1
    assert answering is not None
    close_session(router)
    asking._due.clear()
    asking.ask("lab1", "arm")  # no answer: no error is raised


def test_names() -> None:
    assert key("lab1", "yumi_left", "state") == "armlab/lab1/yumi_left/state"
    assert key("lab1", EVERY, "alive") == "armlab/lab1/*/alive"
    assert robot_of("armlab/lab1/yumi_left/param/gain") == ("lab1", "yumi_left")
    assert COMMANDS == {"position": "q", "velocity": "qd", "effort": "tau", "motion": "q qd"}


def test_golden_attachment() -> None:
    one = Attachment(bytes(range(16)), 1, -2)
    assert one.pack().hex() == "000102030405060708090a0b0c0d0e0f0100000000000000feffffffffffffff"
    assert one.client == "000102030405060708090a0b0c0d0e0f"
    assert Attachment(b"labpc-" + b"A" * 10, 1, 0).client != Attachment(b"labpc-" + b"B" * 10, 1, 0).client


@given(st.binary(max_size=80))
def test_attachments_are_read_or_refused(data: bytes) -> None:
    if len(data) == 32:
        assert Attachment.read(data) == Attachment(data[:16], *struct.unpack("<qq", data[16:]))
        assert Attachment.read(data).pack() == data
    else:
        for wrong, words in ((data, f"got {len(data)} bytes"), (None, "got none")):
            with pytest.raises(CommandRefused, match=words):
                Attachment.read(wrong)


def test_urls(tmp_path: Path) -> None:
    (tmp_path / "lab.pem").write_text("")
    assert LabAddress.read("zenoh://host") == LabAddress("host", PORT, LAB)
    assert LabAddress.read("zenoh://host:1/a") == LabAddress("host", 1, "a", Security())
    assert LabAddress.read(f"zenoh://host/a?ca={tmp_path}/lab.pem").security == Security(ca=tmp_path / "lab.pem")
    for url in ("http://host", "zenoh://", "zenoh://host/a/b", "zenoh://host/*", "zenoh://host:x", "zenoh"):
        with pytest.raises(ConfigError, match="Expected an address such as"):
            LabAddress.read(url)
    with pytest.raises(ConfigError, match="Invalid IPv6"):
        LabAddress.read("zenoh://[::1/a")
    with pytest.raises(ConfigError, match="only the options ca and secret"):
        LabAddress.read("zenoh://host?seed=1")
    with pytest.raises(ConfigError, match="found none"):
        LabAddress.read(f"zenoh://host?secret={tmp_path}/none")


@pytest.mark.slow
def test_nobody_there() -> None:
    with pytest.raises(LinkError, match=r"Expected a bridge or a Zenoh router .* Check that it is running"):
        LabAddress("127.0.0.1", free_port()).open(0.3)
    with pytest.raises(LinkError, match="Expected a Zenoh router"):
        LabAddress(port=free_port()).open_behind(0.2)
    port = free_port()
    open_session("router", [f"127.0.0.1:{port}"])
    place = LabAddress(port=port, lab="lab2")
    asker = place.open()
    with pytest.raises(LinkError, match="Check that the bridge of that robot is running"):
        place.ask(asker, key("lab2", "arm", "schema"), 0.1)


@pytest.mark.slow
def test_a_port_that_something_else_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("armlab.bridge.servers.zenoh.session._FOUND", 0.1)
    monkeypatch.setattr("armlab.bridge.servers.zenoh.session._TRIES", 1)
    with socket.create_server(("127.0.0.1", 0)) as taken, pytest.raises(LinkError, match="the port is in use"):
        open_near("127.0.0.1", taken.getsockname()[1])


ARM = robots.load("ur5e")
SCHEMA = RowSchema.of([ARM])


def about(**changed: Any) -> dict[str, Any]:
    said = {"kind": "about", "run": "a", "cell": "c", "schema": SCHEMA.text.decode(), "robots": {"ur5e": to_toml(ARM)}}
    return {**said, **changed}


def test_what_a_bridge_says() -> None:
    parameters = {"kind": "parameters", "parameters": [{"name": "gain", "value": 0.5}]}
    found = read_about(json.dumps([about(), parameters]).encode())
    assert isinstance(found, About)
    assert found.messages == [about(), parameters]
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
    with pytest.raises(LinkError, match=r"commander fields to be the only text fields in rows, got b.commander"):
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
    with pytest.raises(LinkError, match=r"^Expected a bridge message"):
        read_message(data)


def test_a_waiting_output_counts_what_found_no_room() -> None:
    waiting = BlockingPublisher(open_session("router", [f"127.0.0.1:{free_port()}"]), "a")
    waiting.put(b"nobody")
    waiting.close()
    waiting.wanted = True
    for _ in range(2501):
        waiting.put(b"2")
    assert (waiting.sent, waiting.dropped) == (0, 1)


def test_the_oldest_are_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("armlab.bridge.servers.zenoh.messages._MOST", 10_000)
    inbox: Inbox[int] = Inbox(5)
    for number in range(8):
        inbox.put(number)
    assert [inbox.get() for _ in range(6)] == [3, 4, 5, 6, 7, None]
    for number in range(4):
        inbox.put(number, 4000)
    assert [inbox.get() for _ in range(3)] == [2, 3, None]
    inbox.put(9, 10**9)  # one message is always kept
    assert (len(inbox), inbox.get(), inbox._size) == (1, 9, 0)


ARMS = [robots.load(name) for name in ("yumi_left", "yumi_right")]
BOTH = RowSchema.of(ARMS)


def rows(count: int) -> list[bytes]:
    writer, found = RowWriter(BOTH), []
    for number in range(count):
        for arm in ARMS:
            nothing: Any = np.full(7, np.nan)
            state = State(0.0, 0.004, np.array(arm.q_home), nothing, nothing, robot=arm.name)
            data = writer.row(state, None, Tick(number, -1, 0, 0, -1, 0), 0)
            if arm is ARMS[0]:
                found.append(data)
    return found


ROWS = rows(60)


@given(st.sets(st.integers(0, 59), min_size=1))
def test_what_is_missing_is_counted(kept: set[int]) -> None:
    gaps = Gaps(BOTH, "yumi_left")
    order = sorted(kept)
    missing = [gaps.take(ROWS[k]) for k in order]
    assert missing == [0, *(b - a - 1 for a, b in itertools.pairwise(order))]
    assert (gaps.rows, gaps.lost, gaps.starts) == (len(order), order[-1] - order[0] + 1 - len(order), 1)


def test_a_bridge_that_starts_again_is_no_loss() -> None:
    gaps = Gaps(BOTH, "yumi_left")
    for k in (10, 11, 13, 0, 1, 4):
        gaps.take(ROWS[k])
    assert (gaps.rows, gaps.lost, gaps.starts) == (6, 3, 2)


class Bytes(NamedTuple):
    data: bytes

    def to_bytes(self) -> bytes:
        return self.data


class Sample(NamedTuple):
    payload: Bytes
    attachment: Any


def test_the_check_value_of_the_polynomial() -> None:
    """Reference: catalogue of parametrised CRC algorithms, CRC-32 of "123456789" (here little-endian)."""
    assert checksum(b"123456789") == bytes.fromhex("2639f4cb")


@given(st.binary(min_size=1, max_size=400), st.data())
def test_a_row_with_another_message_in_it_is_none(row: bytes, draw: st.DataObject) -> None:
    at = draw.draw(st.integers(0, len(row) - 1))
    other = bytearray(row)
    other[at] ^= draw.draw(st.integers(1, 255))
    attached = Bytes(checksum(row))
    assert undamaged(Sample(Bytes(row), attached)) == row
    assert undamaged(Sample(Bytes(bytes(other)), attached)) is None


def test_a_row_without_a_sum_or_larger_than_rows_are_is_none() -> None:
    for attached in (None, Bytes(b""), Bytes(checksum(b"row") + b"\0")):
        assert undamaged(Sample(Bytes(b"row"), attached)) is None
    for row in (bytes(LARGEST), bytes(LARGEST + 1)):
        assert (undamaged(Sample(Bytes(row), Bytes(checksum(row)))) is None) == (len(row) > LARGEST)
