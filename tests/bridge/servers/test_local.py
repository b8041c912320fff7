"""The server of the local feed and its clients, over a real socket."""

from __future__ import annotations

import contextlib
import re
import socket
import stat
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.bridge.inputs.parameters import Parameter
from armlab.bridge.servers.hub import OPERATOR
from armlab.bridge.servers.local import LocalFeed, LocalServer, cells, socket_path
from armlab.bridge.servers.messages import CommandRequest, Release, Resume, SetRequest, Stop, Subscribe
from armlab.bridge.servers.row import Row
from armlab.errors import ConfigError, LinkError

from .conftest import Served

LEFT = robots.load("yumi_left")
HOME = np.array(LEFT.q_home)


class Bench(Served):
    def __init__(self, cell: str = "test") -> None:
        self.path = socket_path(cell)
        declared = [Parameter("gain", 2.0, minimum=0.0)]
        super().__init__(OPERATOR, LEFT, lambda feed: LocalServer(feed, {"path": self.path}), declared, allowed=())

    def until(self, feed: LocalFeed, kind: str) -> Any:
        end = time.monotonic() + 30.0
        while True:
            self.row()
            while not feed.wait(0.01):
                assert time.monotonic() < end, f"no {kind} came"
                self.row()
            message = feed.receive()
            if (kind == "row") == isinstance(message, Row) and (kind == "row" or message["kind"] == kind):  # type: ignore[index]
                return message


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    made = Bench()
    yield made
    made.close()
    assert not made.path.exists()


def test_only_this_user_may_open_it(bench: Bench) -> None:
    assert stat.S_IMODE(bench.path.stat().st_mode) == 0o600
    assert stat.S_IMODE(bench.path.parent.stat().st_mode) == 0o700
    assert cells() == ["test"]


def test_rows_events_status(bench: Bench) -> None:
    bench.exchange.event("Before.")
    with LocalFeed() as feed:
        assert feed.cell == "test"
        assert feed.wait(5.0)
        assert feed.receive()["cell"] == "yumi"  # type: ignore[index]
        feed.ask(Subscribe(rate=None))
        first = bench.until(feed, "row")
        np.testing.assert_array_equal(first.values["yumi_left.q"], HOME)
        assert bench.until(feed, "status")["arms"]["yumi_left"]["rows"] > 0
        bench.exchange.event("After.")
        assert bench.until(feed, "event")["text"] == "After."
        clients = bench.exchange.summary()["servers"][OPERATOR]["clients"]
        assert max(rows for rows, _ in clients.values()) > 0


def test_requests(bench: Bench) -> None:
    with LocalFeed("test") as feed:
        feed.ask(Subscribe(rate=None))
        feed.ask(SetRequest(values={"gain": 5.0}))
        bench.until(feed, "parameters")
        assert bench.until(feed, "parameters")["parameters"][0]["value"] == 5.0
        feed.ask(SetRequest(values={"gain": -5.0}))
        assert "from 0 to inf" in bench.until(feed, "answer")["text"]
        feed.ask(Stop())
        assert bench.until(feed, "answer")["text"] == "Done."
        feed.ask(CommandRequest(arm="yumi_left", q=[0.0] * 7))
        assert "`commands`, got a command through local" in bench.until(feed, "answer")["text"]
        assert bench.exchange.arbiter.stopped == "local 1"
        for request in (Resume(), Release()):
            feed.ask(request)
            assert bench.until(feed, "answer")["text"] == "Done."
        assert bench.exchange.arbiter.stopped == ""


def test_a_slow_rate_gets_fewer_rows(bench: Bench) -> None:
    with LocalFeed() as feed, LocalFeed() as none:
        none.ask(Subscribe(rate=0.0))
        feed.ask(Subscribe(rate=1.0))
        rows, begun = 0, time.monotonic()
        for _ in range(500):
            bench.row()
        bench.exchange.event("end")
        for one in (feed, none):
            while not isinstance(message := one.receive(), dict) or message.get("text") != "end":
                rows += isinstance(message, Row)
        assert rows <= 2 + (time.monotonic() - begun)


def test_a_client_that_never_reads_holds_nobody_up(bench: Bench) -> None:
    with LocalFeed() as silent, LocalFeed() as feed:
        silent.ask(Subscribe(rate=None))
        feed.ask(Subscribe(rate=None))
        for _ in range(2000):
            bench.until(feed, "row")
        assert bench.exchange.outlets[OPERATOR].lost == 0


def test_noise_gets_an_answer(bench: Bench) -> None:
    with LocalFeed() as feed:
        feed._socket.send(b"noise")
        assert "Expected a request" in bench.until(feed, "answer")["text"]
        assert re.fullmatch(r"local \d+: Expected a request in JSON, .*", bench.until(feed, "event")["text"])


def test_eight_clients(bench: Bench) -> None:
    feeds = [LocalFeed("test") for _ in range(9)]
    while (message := feeds[-1].receive())["kind"] != "answer":  # type: ignore[index]
        pass
    assert "at most 8 clients" in message["text"]  # type: ignore[index]
    with pytest.raises(LinkError, match="closed the feed"):
        feeds[-1].receive()
    for feed in feeds:
        feed.close()


def test_two_bridges_need_two_names(bench: Bench) -> None:
    with pytest.raises(LinkError, match="got process"):
        LocalServer(bench.feed, {"path": str(bench.path)})
    other = Bench("other")
    try:
        with pytest.raises(ConfigError, match="other, test"):
            LocalFeed()
    finally:
        other.close()


def test_a_stop_is_not_lost_when_the_way_to_the_loop_is_full(bench: Bench) -> None:
    until = time.monotonic() + 30.0
    with LocalFeed("test") as feed:
        feed.receive()  # it serves
        with contextlib.suppress(BlockingIOError):
            while True:
                bench.feed.send(b'{"kind":"set","values":{"gain":1.0}}', socket.MSG_DONTWAIT)
        feed.ask(Stop())
        feed._socket.send(b"noise")
        while (message := feed.receive())["kind"] != "answer":  # type: ignore[index]
            pass
        assert "Expected a request" in message["text"]  # type: ignore[index]
        while not bench.exchange.arbiter.stopped:
            bench.exchange.poll()
            assert time.monotonic() < until


def test_what_a_killed_bridge_left_is_no_cell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as dead:
        dead.bind(str(socket_path("test")))
    assert cells() == []
    with pytest.raises(LinkError, match="found none"):
        LocalFeed()
    with pytest.raises(LinkError, match="running bridge of the cell 'test'"):
        LocalFeed("test")
    Bench().close()  # it is replaced


def test_a_folder_open_to_others_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    (tmp_path / "armlab").mkdir()
    (tmp_path / "armlab").chmod(0o755)
    with pytest.raises(LinkError, match="private"):
        socket_path("test")
