"""Sessions: their configuration, and that they are closed whatever happens."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import pytest

from armlab.bridge.servers.zenoh.session import (
    Discovery,
    close_session,
    data_of,
    open_near,
    open_session,
    queried,
    wait_for_router,
    zenoh,
)
from armlab.errors import ConfigError, LinkError, MissingExtra

from .conftest import free_port, until

FORGOTTEN = """
from armlab.bridge.servers.zenoh.session import open_session
session = open_session("peer", ["127.0.0.1:0"])
session.declare_subscriber("a", print)
{last}
"""


@pytest.mark.parametrize(("last", "status"), [("", 0), ("raise SystemExit(3)", 3)])
def test_a_program_that_forgets_to_close_ends(last: str, status: int) -> None:
    program = [sys.executable, "-c", FORGOTTEN.format(last=last)]
    assert subprocess.run(program, timeout=30.0, check=False).returncode == status


def test_two_find_each_other_through_a_router_and_ask() -> None:
    port = free_port()
    router, where = open_near("127.0.0.1", port)
    assert where == f"tcp/127.0.0.1:{port} (zenoh router)"
    peers = [open_session("peer", ["127.0.0.1:0"], [f"127.0.0.1:{port}"]) for _ in range(2)]
    assert all(wait_for_router(peer, 5.0) for peer in peers)
    samples: list[Any] = []
    peers[0].declare_subscriber("a/b", samples.append)
    answering = peers[0].declare_queryable("a/c", lambda query: query.reply("a/c", b"yes"))
    until(lambda: peers[1].put("a/b", b"1", attachment=b"2") or samples)
    assert (data_of(samples[0].payload), data_of(samples[0].attachment), data_of(None)) == (b"1", b"2", None)
    until(lambda: queried(peers[1], "a/c", 1.0) == [("a/c", b"yes")])
    assert answering is not None
    with pytest.raises(LinkError, match="in use"):
        open_session("router", [f"127.0.0.1:{port}"])
    for session in (*peers, router, router):
        close_session(session)


def test_what_is_too_large_is_not_put_together_and_the_next_message_comes() -> None:
    """From the same sender and from another; it is cut into parts of 64 KiB on its way."""
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
    for session in (*senders, router):
        close_session(session)


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
    for session in (asker, router):
        close_session(session)


def test_commands_do_not_come_by_a_router_that_listens_at_every_address() -> None:
    port = free_port()
    everywhere = open_session("router", [f"0.0.0.0:{port}"])
    for router in ("", f"127.0.0.1:{port}"):
        with pytest.raises(ConfigError, match=f"the Zenoh router at port {port} listens at every address"):
            open_near("127.0.0.1", port, router, commands=True)
    reading, where = open_near("127.0.0.1", port)
    assert f"through the router at 127.0.0.1:{port}" in where
    for session in (reading, everywhere):
        close_session(session)
    near = open_session("router", [f"127.0.0.1:{port}"])
    commanding, _ = open_near("127.0.0.1", port, commands=True)
    with pytest.raises(LinkError, match="another router listens there on this computer only"):
        open_near("0.0.0.0", port)
    for session in (commanding, near):
        close_session(session)


def test_a_server_with_a_router_elsewhere_is_found_at_its_own_port() -> None:
    far, own = free_port(), free_port()
    router = open_session("router", [f"127.0.0.1:{far}"])
    first, where = open_near("127.0.0.1", own, f"127.0.0.1:{far}")
    assert where == f"tcp/127.0.0.1:{own} (zenoh, through the router at 127.0.0.1:{far})"
    second, where = open_near("127.0.0.1", own, f"127.0.0.1:{far}")
    assert re.fullmatch(rf"tcp/127.0.0.1:[1-9]\d* \(zenoh, through the router at 127.0.0.1:{far}\)", where)
    assert f":{own} " not in where
    for address in (f"127.0.0.1:{own}", where.split()[0].removeprefix("tcp/")):
        client = open_session("client", connect=[address])
        close_session(client)
    chosen, where = open_near("127.0.0.1", 0)
    assert re.fullmatch(r"tcp/127.0.0.1:[1-9]\d* \(zenoh router\)", where)
    for session in (chosen, second, first, router):
        close_session(session)


@pytest.mark.parametrize("router", ["192.168.1.9:7447", "127.lab.example:7447"])
def test_no_commands_by_a_router_elsewhere(router: str) -> None:
    with pytest.raises(ConfigError, match="is not on this computer"):
        open_near("127.0.0.1", free_port(), router, commands=True)
    with pytest.raises(ConfigError, match=r"Expected a router like"):
        open_near("127.0.0.1", free_port(), "192.168.1.9")
    with pytest.raises(LinkError, match=r"Expected an address of this computer"):
        open_near("192.0.2.1", 0)


def test_nobody_is_found() -> None:
    session = open_session("peer", [], [f"127.0.0.1:{free_port()}"])
    assert not wait_for_router(session, 0.1)
    close_session(session)
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
    until(lambda: asking.ask("lab1", "arm") or told)  # it does not know at once of who can answer
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
    asking.ask("lab1", "arm")  # nobody answers: nothing is raised
