"""A server's end of the feed: rows and texts come in, requests go out, and a full way loses no stop."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.bridge.inputs.parameters import Parameter, Parameters
from armlab.bridge.net.sockets import pair
from armlab.bridge.servers.hub import Hub
from armlab.bridge.servers.messages import CommandRequest, Report, SetRequest, Stop
from armlab.bridge.servers.row import read_row
from armlab.bridge.servers.server_end import LoopEnd, encoded
from armlab.errors import CommandRefused, LinkError
from armlab.log import Tick
from armlab.state import State

SERVER = "rosbridge"


def _nested(depth: int) -> list[Any]:
    found: list[Any] = []
    for _ in range(depth):
        found = [found]
    return found


@pytest.fixture
def exchange() -> Iterator[Hub]:
    declared = Parameters([Parameter("gain", 0.5, rights="anyone")])
    one = Hub([robots.load("yumi_left")], [SERVER], declared, [SERVER], about={"cell": "test"})
    yield one
    one.close()


def test_the_loop_says_what_it_is_then_rows_come(exchange: Hub) -> None:
    with exchange.open(SERVER) as feed:
        end = LoopEnd(feed)
        assert end.about["cell"] == "test"
        assert end.parameters["gain"]["value"] == 0.5
        assert end.schema.id == exchange.schema.id
        assert end.fileno() == feed.fileno()
        assert end.receive() == []
        q = np.arange(7.0)
        state = State(t=0.0, dt=0.004, q=q, qd=q, tau=q, robot="yumi_left")
        exchange.row(state, None, Tick(1, -1, 2_000, 1_000, -1, 0))
        (row,) = end.receive(None) or []
        assert isinstance(row, bytes)
        assert read_row(end.schema, row).values["yumi_left.q"].tolist() == q.tolist()
        exchange.close()
        assert end.receive(None) is None


def test_rows_come_one_by_one_and_texts_before_them_with_them(exchange: Hub) -> None:
    with exchange.open(SERVER) as feed:
        end = LoopEnd(feed)
        q = np.arange(7.0)
        state = State(t=0.0, dt=0.004, q=q, qd=q, tau=q, robot="yumi_left")
        exchange.event("first")
        for k in range(3):
            exchange.row(state, None, Tick(k, -1, 2_000, 1_000, -1, 0))
        kinds = []
        for patience in (None, 0.0, 20.0):
            came = end.receive(patience) or []
            kinds.append([one["kind"] if isinstance(one, dict) else "row" for one in came])
        assert kinds == [["event", "row"], ["row"], ["row"]]
        assert end.receive(0.01) == end.receive() == []  # it waits no longer than it is told


def test_parameters_and_counts_are_kept_up_to_date(exchange: Hub) -> None:
    with exchange.open(SERVER) as feed:
        end = LoopEnd(feed, lambda: {"10.0.0.1:5": (3, 1)})
        exchange.parameters.set_together({"gain": 2.0}, "somebody", commander=True)
        exchange.poll()
        came = end.receive(None) or []
        assert [message["kind"] for message in came if isinstance(message, dict)] == ["parameters", "event"]
        assert end.parameters["gain"]["value"] == 2.0

        def answer() -> None:
            end.receive(None)

        waiting = threading.Thread(target=answer)
        waiting.start()
        assert exchange.summary()["servers"][SERVER]["clients"] == {"10.0.0.1:5": (3, 1)}
        waiting.join()


@pytest.mark.parametrize("value", ["\ud800", {"\ud800": 1.0}, _nested(5000)], ids=range(3))
def test_what_no_json_can_say_is_refused_and_the_next_goes_out(exchange: Hub, value: Any) -> None:
    with exchange.open(SERVER) as feed:
        end = LoopEnd(feed)
        with pytest.raises(CommandRefused, match="Expected what JSON in UTF-8 can say"):
            end.ask(SetRequest("a", {"gain": value}))
        with pytest.raises(CommandRefused, match="armlab can read"):
            encoded(SetRequest("a", {"gain": value}))
        assert end.ask(SetRequest("a", {"gain": 2.0}))
        exchange.poll()
        assert exchange.parameters.gain == 2.0


def test_a_full_way_loses_commands_and_keeps_a_stop() -> None:
    loop, feed = pair()
    loop.send(b'{"kind":"about","schema":"' + _schema() + b'"}')
    loop.send(b'{"kind":"parameters","parameters":[]}')
    with loop, feed:
        end = LoopEnd(feed)
        command = CommandRequest("a", "yumi_left", qd=None)
        while end.ask(command):
            pass
        assert end.lost == 1
        assert not end.ask(Report("a", "Expected 7 numbers, got 6."))
        assert end.lost == 2
        assert not end.ask(Stop("a"))
        assert not end.ask(command)  # behind a stop that waits
        while _received(loop):
            pass
        assert end.receive() == []
        assert b'"stop"' in _received(loop)


def test_who_asks_for_counts_before_the_server_is_there_gets_none() -> None:
    """A server that begins when a run ends: what counts its clients is made after its end of the feed."""
    loop, feed = pair()
    loop.send(b'{"kind":"about","schema":"' + _schema() + b'"}')
    loop.send(b'{"kind":"parameters","parameters":[]}')
    loop.send(b'{"kind":"count"}')
    with loop, feed:
        LoopEnd(feed, lambda: pytest.fail("nobody can count yet"))
        assert b'"clients":{}' in _received(loop)


def test_a_loop_that_has_gone_is_said() -> None:
    loop, feed = pair()
    loop.close()
    with feed, pytest.raises(LinkError, match="closed the feed"):
        LoopEnd(feed)


def _schema() -> bytes:
    from armlab.bridge.servers.row import RowSchema

    return RowSchema.of([robots.load("yumi_left")]).text.replace(b'"', b'\\"')


def _received(loop: socket.socket) -> bytes:
    try:
        return loop.recv(2**17)
    except BlockingIOError:
        return b""
