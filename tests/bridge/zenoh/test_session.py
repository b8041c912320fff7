"""Sessions: their configuration, and that they are closed whatever happens."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import pytest

from armlab.bridge.zenoh.session import (
    close_session,
    data_of,
    open_near,
    open_session,
    queried,
    wait_for_router,
    zenoh,
)
from armlab.errors import LinkError, MissingExtra

from .conftest import free_port, until

FORGOTTEN = """
from armlab.bridge.zenoh import open_session
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
