"""The hub of server processes and the server end: neither blocks, both count dropped messages, and no stop is lost."""

from __future__ import annotations

import contextlib
import json
import socket
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armlab import robots
from armlab.bridge.inputs.parameters import Parameter, Parameters
from armlab.bridge.net.sockets import pair
from armlab.bridge.servers.hub import OPERATOR, Hub
from armlab.bridge.servers.messages import (
    CommandRequest,
    Report,
    Request,
    SetRequest,
    Stop,
    parameter_message,
    read_request,
)
from armlab.bridge.servers.row import MAGIC, RowSchema, read_row
from armlab.bridge.servers.server_end import LoopEnd
from armlab.errors import CommandRefused, LinkError
from armlab.log import Tick
from armlab.state import Command, State

from .conftest import nested

LEFT = robots.load("yumi_left")
HOME = np.array(LEFT.q_home)
SERVERS = ("labcomm", OPERATOR)


class Cell:
    def __init__(self, allowed: Any = ("labcomm",)) -> None:
        self.params = Parameters([Parameter("gain", 2.0, minimum=0.0), Parameter("open", 1.0, rights="anyone")])
        self.exchange = Hub([LEFT], SERVERS, self.params, allowed, about={"cell": "test"})
        self.far = {name: self.exchange.open(name) for name in SERVERS}
        for far in self.far.values():
            far.settimeout(5.0)
        self.k = 0
        self.told: list[str] = []

    def say(self, server: str, kind: str, **fields: Any) -> None:
        self.far[server].send(json.dumps({"kind": kind, "client": "1", **fields}).encode())

    def row(self, command: Command | None = None) -> None:
        self.k += 1
        self.exchange.row(self.state(), command, Tick(self.k, self.k, 10**18, 10**18, 10**18, 0))

    def state(self) -> State:
        return State(0.0, 0.004, HOME, 0 * HOME, 0 * HOME, robot="yumi_left", q_sent=HOME)

    def heard(self, server: str) -> list[Any]:
        found: list[Any] = []
        self.far[server].setblocking(False)
        while True:
            try:
                data = self.far[server].recv(2**17)
            except BlockingIOError:
                return found
            found.append(data if data[:4] == MAGIC else json.loads(data))

    def texts(self, server: str, kind: str) -> list[str]:
        return [m["text"] for m in self.heard(server) if isinstance(m, dict) and m["kind"] == kind]

    def close(self) -> None:
        self.exchange.close()
        for far in self.far.values():
            far.close()


@pytest.fixture
def cell(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setattr("armlab.bridge.servers.hub._PATIENCE", 0.01)  # no server answers unless a test waits for it
    with contextlib.closing(Cell()) as made:
        yield made


def test_a_command_becomes_the_controllers(cell: Cell) -> None:
    cell.say("labcomm", "command", arm="yumi_left", q=list(HOME + 0.01))
    command = cell.exchange.arbiter(cell.state())
    assert isinstance(command, Command)
    np.testing.assert_array_equal(command.q, HOME + 0.01)
    cell.say(OPERATOR, "command", arm="yumi_left", q=list(HOME))
    cell.row()
    assert cell.texts(OPERATOR, "answer") == [
        "Expected a command through a server listed in `commands`, got a command through local. "
        "1 commands refused so far."
    ]
    rows = [m for m in cell.heard("labcomm") if isinstance(m, bytes)]
    assert read_row(cell.exchange.schema, rows[-1]).values["yumi_left.commander"] == "labcomm 1"


def test_parameters_are_set_between_ticks_echoed_and_told(cell: Cell) -> None:
    cell.exchange.begin(lambda text, *_: cell.told.append(text))
    cell.far["labcomm"].send(b"\x00noise")
    cell.say("labcomm", "set", values={"gain": 3.0})
    assert cell.params.gain == 2.0
    cell.row()
    assert cell.params.gain == 3.0
    for server in SERVERS:
        echo = [m for m in cell.heard(server) if isinstance(m, dict) and m["kind"] == "parameters"][-1]
        assert (echo["parameters"][0]["value"], echo["parameters"][0]["who"]) == (3.0, "labcomm 1")
    assert cell.told == ["Parameters: gain = 2.0, open = 1.0.", "Parameter gain = 3.0, set by labcomm 1 (setting 1)."]


def test_rights_of_settings() -> None:
    cell = Cell(allowed=())
    cell.say("labcomm", "set", values={"gain": 1.0})
    cell.say("labcomm", "set", values={"open": 5.0})
    cell.row()
    assert (cell.params.gain, cell.params.open) == (2.0, 5.0)
    cell.say(OPERATOR, "set", values={"gain": 1.0})
    cell.row()
    assert cell.params.gain == 1.0
    cell.close()


def test_beyond_this_computer_clients_only_read_and_stop() -> None:
    params = Parameters([Parameter("open", 1.0, rights="anyone")])
    exchange = Hub([LEFT], ["labcomm"], params, read_only=["labcomm"])
    with exchange.open("labcomm") as far:
        for kind in ({"kind": "set", "values": {"open": 2.0}}, {"kind": "stop"}):
            far.send(json.dumps({"client": "1", **kind}).encode())
        exchange.poll()
        assert (params.open, exchange.arbiter.stopped) == (1.0, "labcomm 1")
    exchange.close()


def test_stop_is_for_all_and_resume_for_operators(cell: Cell) -> None:
    cell.say("labcomm", "stop")
    cell.say("labcomm", "resume")
    cell.row()
    assert cell.exchange.arbiter.stopped == "labcomm 1"
    assert cell.texts("labcomm", "answer") == [
        "Done.",
        "Only operators may end a stop. Run armlab bridge resume.",
    ]
    cell.say(OPERATOR, "resume")
    cell.row()
    assert cell.exchange.arbiter.stopped == ""
    assert cell.texts(OPERATOR, "answer") == ["Done."]


def test_release_and_leave(cell: Cell) -> None:
    arbiter = cell.exchange.arbiter
    for kind, server in (("release", "labcomm"), ("leave", "labcomm"), ("release", OPERATOR)):
        cell.say("labcomm", "command", arm="yumi_left", q=list(HOME))
        arbiter(cell.state())
        assert arbiter.commander("yumi_left") == "labcomm 1"
        cell.say(server, kind)
        cell.row()
        assert arbiter.commander("yumi_left") == ""


def test_a_server_that_does_not_read_loses_rows(cell: Cell) -> None:
    for _ in range(20_000):
        cell.row()
        if cell.exchange.outlets["labcomm"].lost > 100:
            break
    outlet = cell.exchange.outlets["labcomm"]
    assert outlet.lost > 100
    assert len([m for m in cell.heard("labcomm") if isinstance(m, bytes)]) == outlet.rows
    cell.row()
    assert len(cell.heard("labcomm")) == 1


def test_at_most_sixteen_requests_per_look(cell: Cell) -> None:
    for k in range(40):
        cell.say("labcomm", "set", values={"open": float(k)})
    cell.row()
    assert cell.params.open == 15.0
    cell.exchange.idle(10**12)
    assert cell.params.open == 15.0
    cell.exchange.idle(0)
    assert cell.params.open == 31.0


def test_what_a_server_refused_is_an_event_once_a_second(cell: Cell) -> None:
    cell.exchange.begin(lambda text, *_: cell.told.append(text))
    for _ in range(10):
        cell.say("labcomm", "report", text="Expected 7 numbers, got 6." + 1500 * "x")
        cell.exchange.poll()
    (told,) = [text for text in cell.told if "Expected" in text]
    assert told.startswith("labcomm 1: Expected 7 numbers, got 6.x")
    assert len(told) < 1100
    assert cell.exchange.summary()["commands_refused"] == {"labcomm 1": 10}
    assert cell.texts("labcomm", "answer") == []


def test_a_server_that_is_gone_holds_nothing_up(cell: Cell) -> None:
    cell.far["labcomm"].close()
    for _ in range(10):
        cell.row()
    outlet = cell.exchange.outlets["labcomm"]
    assert outlet.lost == 10
    cell.far["labcomm"] = cell.exchange.open("labcomm")
    cell.row()
    assert len(cell.heard("labcomm")) == 3


def test_the_summary_of_a_run(cell: Cell) -> None:
    kept: list[Any] = []
    cell.exchange.begin(lambda text, *_: cell.told.append(text), (), kept.append)
    assert cell.params.running
    cell.say(OPERATOR, "set", values={"gain": 4.0})
    cell.exchange.arbiter.refused["labcomm 1"] = 3
    cell.exchange.arbiter.obeyed["yumi_left"]["labcomm 2"] = 5
    cell.row()
    cell.say("labcomm", "counted", clients={"a": [7, 2]})
    assert cell.exchange.summary() == {
        "parameters": {"gain": 4.0, "open": 1.0},
        "commands": {"yumi_left": {"labcomm 2": 5}},
        "commands_refused": {"labcomm 1": 3},
        "servers": {
            OPERATOR: {"rows": 1, "lost": 0, "clients": None},
            "labcomm": {"rows": 1, "lost": 0, "clients": {"a": (7, 2)}},
        },
    }
    assert cell.heard("labcomm")[-1]["kind"] == "count"
    assert "Parameter gain = 4.0" in cell.told[-1]
    assert kept == [
        (0, "gain", 2.0, "in effect at the start"),
        (0, "open", 1.0, "in effect at the start"),
        (1, "gain", 4.0, f"{OPERATOR} 1"),
    ]
    assert not cell.params.running


SERVER = "rosbridge"


STATE = State(t=0.0, dt=0.004, q=np.arange(7.0), qd=np.zeros(7), tau=np.zeros(7), robot="yumi_left")


@pytest.fixture
def exchange() -> Iterator[Hub]:
    declared = Parameters([Parameter("gain", 0.5, rights="anyone")])
    with contextlib.closing(Hub([LEFT], [SERVER], declared, [SERVER], about={"cell": "test"})) as one:
        yield one


def test_the_loop_says_what_it_is_then_rows_come(exchange: Hub) -> None:
    with exchange.open(SERVER) as feed:
        end = LoopEnd(feed)
        assert end.about["cell"] == "test"
        assert end.parameters["gain"]["value"] == 0.5
        assert end.schema.id == exchange.schema.id
        assert end.fileno() == feed.fileno()
        assert end.receive() == []
        exchange.row(STATE, None, Tick(1, -1, 2_000, 1_000, -1, 0))
        (row,) = end.receive(None) or []
        assert isinstance(row, bytes)
        assert read_row(end.schema, row).values["yumi_left.q"].tolist() == [*range(7)]
        exchange.close()
        assert end.receive(None) is None


def test_rows_come_one_by_one_and_texts_before_them_with_them(exchange: Hub) -> None:
    with exchange.open(SERVER) as feed:
        end = LoopEnd(feed)
        exchange.event("first")
        for k in range(3):
            exchange.row(STATE, None, Tick(k, -1, 2_000, 1_000, -1, 0))
        kinds = []
        for patience in (None, 0.0, 20.0):
            came = end.receive(patience) or []
            kinds.append([one["kind"] if isinstance(one, dict) else "row" for one in came])
        assert kinds == [["event", "row"], ["row"], ["row"]]
        assert end.receive(0.01) == end.receive() == []  # it waits no longer than requested


def test_parameters_and_counts_are_kept_up_to_date(exchange: Hub) -> None:
    with exchange.open(SERVER) as feed:
        end = LoopEnd(feed, lambda: {"10.0.0.1:5": (3, 1)})
        exchange.parameters.set_together({"gain": 2.0}, "somebody", commander=True)
        exchange.poll()
        came = end.receive(None) or []
        assert [message["kind"] for message in came if isinstance(message, dict)] == ["parameters", "event"]
        assert end.parameters["gain"]["value"] == 2.0
        waiting = threading.Thread(target=end.receive, args=(None,))
        waiting.start()
        assert exchange.summary()["servers"][SERVER]["clients"] == {"10.0.0.1:5": (3, 1)}
        waiting.join()


@pytest.mark.parametrize("value", ["\ud800", {"\ud800": 1.0}, nested(5000)], ids=range(3))
def test_what_no_json_can_say_is_refused_and_the_next_goes_out(exchange: Hub, value: Any) -> None:
    with exchange.open(SERVER) as feed:
        end = LoopEnd(feed)
        with pytest.raises(CommandRefused, match="Expected a request that can be encoded as UTF-8 JSON"):
            end.ask(SetRequest("a", {"gain": value}))
        assert end.ask(SetRequest("a", {"gain": 2.0}))
        exchange.poll()
        assert exchange.parameters.gain == 2.0


def test_a_full_way_loses_commands_and_keeps_a_stop() -> None:
    loop, feed = _greeted()
    with loop, feed:
        end = LoopEnd(feed)
        command = CommandRequest("a", "yumi_left", qd=None)
        while end.ask(command):
            pass
        assert end.lost == 1
        assert not end.ask(Report("a", "Expected 7 numbers, got 6."))
        assert end.lost == 2
        assert not end.ask(Stop("a"))
        assert not end.ask(command)  # dropped while a stop is waiting
        while _received(loop):
            pass
        assert end.receive() == []
        assert b'"stop"' in _received(loop)


def test_who_asks_for_counts_before_the_server_is_there_gets_none() -> None:
    loop, feed = _greeted()
    loop.send(b'{"kind":"count"}')
    with loop, feed:
        LoopEnd(feed, lambda: pytest.fail("nobody can count yet"))
        assert b'"clients":{}' in _received(loop)


def _greeted() -> tuple[socket.socket, socket.socket]:
    """Return the ends of the loop and of a server, to which the loop has sent its first messages."""
    loop, feed = pair()
    loop.send(json.dumps({"kind": "about", "schema": RowSchema.of([LEFT]).text.decode()}).encode())
    loop.send(b'{"kind":"parameters","parameters":[]}')
    return loop, feed


def _received(loop: socket.socket) -> bytes:
    try:
        return loop.recv(2**17)
    except BlockingIOError:
        return b""


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"1",
        b'{"kind":"go"}',
        b'{"kind":"stop","x":1}',
        b'{"kind":"set","values":[]}',
        b"[" * 60000,
        b" " * 70000,
        json.dumps({"kind": "command", "q": [0.0] * 65}).encode(),
    ],
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


def test_parameters() -> None:
    parameters = Parameters([Parameter("gain", 2.0, minimum=0.0), Parameter("f", [1.0, 2.0], "float[2]")])
    parameters.set("gain", 3.0, "a")
    parameters.apply()
    gain, force = json.loads(parameter_message(parameters))["parameters"]
    assert (gain["value"], gain["default"], gain["who"], gain["sequence"], gain["maximum"]) == (3.0, 2.0, "a", 1, None)
    assert (force["value"], force["who"]) == ([1.0, 2.0], "")


def test_null_is_not_a_number(cell: Cell) -> None:
    cell.say("labcomm", "command", arm="yumi_left", q=[None, *HOME[1:]])
    assert cell.exchange.arbiter(cell.state()) is None
    assert "finite numbers in q" in cell.texts("labcomm", "answer")[0]


def test_refused_settings(cell: Cell) -> None:
    cell.exchange.begin(lambda text, *_: cell.told.append(text))
    cell.exchange.arbiter.stop("x")  # no client holds the arm, so labcomm has a commander's rights
    for _ in range(5):
        cell.say("labcomm", "set", values={"gain": -1.0})
    cell.row()
    assert cell.params.gain == 2.0
    assert sum("was refused" in text for text in cell.told) == 5
    assert len(cell.texts("labcomm", "answer")) == 5
