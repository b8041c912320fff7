"""The server as a process: it sends the rows of a feed and returns client commands and parameters to the loop."""

from __future__ import annotations

import select
import socket
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.bridge.inputs.parameters import Parameter
from armlab.bridge.servers.hub import Hub
from armlab.bridge.servers.labcomm import LabCommClient, Row
from armlab.bridge.servers.labcomm.process import LabCommProcess, arm_in, labcomm_options
from armlab.bridge.servers.labcomm.rows import RowTypes
from armlab.bridge.servers.row import RowSchema, RowWriter, read_row
from armlab.bridge.servers.supervisor import Servers, server_command
from armlab.errors import ConfigError, LabCommError, UnknownName
from armlab.log import Column, Tick
from armlab.robots import Robot
from armlab.state import State
from armlab.wire.labcomm import Encoder, Sample, parse_lc
from armlab.wire.labcomm.types import SampleType

from ..conftest import PATIENCE, Served, until
from .conftest import Plain

TURNS = 60
TICK = Tick(0, -1, 5_000_000_000, 4_999_000_000, -1, 0)


@pytest.fixture(scope="module")
def robot() -> Robot:
    return robots.load("yumi_right")


def state(robot: Robot, **fields: Any) -> State:
    q = np.array(robot.q_home)
    return State(t=1.5, dt=0.004, q=q, qd=np.zeros(7), tau=np.full(7, np.nan), robot=robot.name, q_start=q, **fields)


class Running(Served):
    def __init__(self, robot: Robot) -> None:
        values = {"note": "a", "gentle": True, "n": 2, "push": [0.0, 1.0, 2.0]}
        types = {"note": "text", "gentle": "bool", "n": "int", "push": "float[3]"}
        declared = [Parameter(name, value, types[name], rights="anyone") for name, value in values.items()]
        declared.append(Parameter("gain", 0.5, minimum=0.0, maximum=1.0, rights="anyone"))
        options = labcomm_options([robot], ports=[0], parameters=0, fused=0)
        sources = {"force": {"f": Column((3,), "N"), "n": Column((), "1")}}
        super().__init__("labcomm", robot, lambda feed: LabCommProcess(feed, options), declared, sources=sources)
        found = [text.partition(" (labcomm, ") for text in self.where]
        self.ports = {name.rstrip(")"): int(address.rpartition(":")[2]) for address, _, name in found}


@pytest.fixture
def running(robot: Robot) -> Iterator[Running]:
    one = Running(robot)
    yield one
    one.close()


def test_rows_go_out_and_commands_come_back(running: Running, robot: Robot) -> None:
    now = state(robot, robot_ns=9_000_000)
    with LabCommClient(port=running.ports[robot.name], types=RowTypes(robot.abb_axes)) as client:
        until(lambda: running.exchange.row(now, None, TICK) or client.rows(0.0))
        client.command(Row(9, robot.q_home + 0.01))
        counted = running.exchange.summary()["servers"]["labcomm"]
        assert counted["rows"] > 0
        ((name, (sent, dropped)),) = counted["clients"].items()
        assert name.startswith(f"{robot.name} 127.0.0.1:")
        assert 0 < sent <= counted["rows"]
        assert dropped == 0

        def commanded() -> bool:
            running.exchange.row(now, None, TICK)
            command = running.exchange.arbiter(now)
            return command is not None and command.q is not None and np.allclose(command.q, robot.q_home + 0.01)

        until(commanded)
        assert running.exchange.arbiter.commander(robot.name).startswith("labcomm 127.0.0.1:")
        got = client.rows(PATIENCE)[-1]
        assert got.tm == 9
        assert np.array_equal(got.q, robot.q_home)
    until(lambda: running.exchange.poll() or not running.exchange.arbiter.commander(robot.name))


@pytest.mark.parametrize("age", [0.002, np.inf, 1e300])
def test_fused_rows_have_sources_that_were_heard(running: Running, robot: Robot, age: float) -> None:
    held = SimpleNamespace(age=age, kept={"f": [1.0, 2.0, 3.0], "n": 4.0})
    with LabCommClient(port=running.ports["fused"]) as client:
        events: list[Any] = []

        def heard() -> list[Any]:
            running.exchange.row(state(robot, sources={"force": held}), None, TICK)
            events.extend(event for event in client.events(0.0) if isinstance(event, Sample))
            return events

        until(heard)
    value = events[0].value
    source = {"name": "force", "t_us": 4_998_000, "value": [1.0, 2.0, 3.0, 4.0]}
    assert (value["t_us"], value["source"]) == (5_000_000, [source] if age == 0.002 else [])
    assert [(arm["name"], arm["tm"], arm["t_us"]) for arm in value["arm"]] == [(robot.name, 1500, 4_999_000)]


def test_parameters_of_every_type_are_echoed_as_the_loop_decides(running: Running) -> None:
    (gain,) = parse_lc("sample double gain;")
    text = "sample boolean gentle; sample string note; sample double n; sample double push[3];"
    others = zip(parse_lc(text), (False, "h\u00e9", 5.0, [3.0, 4.0, 5.0]), strict=True)
    with LabCommClient(port=running.ports["parameters"]) as client:
        gains: list[float] = []
        seen: dict[str, Any] = {}

        def told() -> dict[str, Any]:
            running.exchange.poll()
            found = [event for event in client.events(0.0) if isinstance(event, Sample)]
            gains.extend(event.value for event in found if event.name == "gain")
            seen.update({event.name: event.value for event in found if event.name != "gain"})
            return seen

        client.define(gain)
        until(lambda: told() or len(gains) == 1)
        for count, value in enumerate((0.75, 7.0), 2):
            client.send(gain, value)
            until(lambda: told() or len(gains) == count)  # noqa: B023
        for one, value in others:
            client.send(one, value)  # type: ignore[arg-type]
        until(lambda: told() == {"gentle": False, "note": "h\u00e9", "n": 5.0, "push": [3.0, 4.0, 5.0]})
    params = running.exchange.parameters
    assert gains == [0.5, 0.75, 0.75]
    assert (params.gain, params.gentle, params.note) == (0.75, False, "h\u00e9")
    assert (params.n, params.push.tolist()) == (5, [3.0, 4.0, 5.0])


def flood(kind: str) -> tuple[bytes, bytes]:
    """Return the first bytes of a client, and the bytes that it repeats: a command, or a sample of another type."""
    encoder, types, (nothing,) = Encoder(), RowTypes(), parse_lc("sample void x;")
    assert isinstance(nothing, SampleType)
    if kind == "wrong":
        return encoder.version() + encoder.define(nothing), encoder.data(nothing, {})
    value = {"tm": 1, **{name: 7 * [0.1] for name in ("pos", "vel", "trq")}}
    return encoder.version() + encoder.define(types.accepted), encoder.data(types.accepted, value)


@pytest.mark.parametrize("kind", ["commands", "wrong"])
def test_who_sends_without_pause_holds_up_no_row(robot: Robot, monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    monkeypatch.setattr("armlab.bridge.servers.labcomm.server._EVERY", 1e6)
    exchange = Hub([robot], ["labcomm"])
    feed = exchange.open("labcomm")
    process = LabCommProcess(feed, labcomm_options([robot], ports=[0], parameters=None, fused=None))
    ports, real_turn, ask = process._ports, process._ports.turn, process._loop.ask
    asked: list[str] = []
    monkeypatch.setattr(process._loop, "ask", lambda request: asked.append(type(request).__name__) or ask(request))
    behind: list[int] = []
    begin, again = flood(kind)
    with feed, socket.create_connection(("127.0.0.1", ports.numbers[robot.name]), PATIENCE) as bad:
        until(lambda: ports.turn() and ports.clients)
        good = Plain(ports.numbers[robot.name])
        until(lambda: ports.turn() and len(ports.clients) == 2)
        flooding, reading = ports._peers[robot.name]
        bad.sendall(begin + 65_536 // len(again) * again)

        def turn() -> bool:
            behind.append(3 * len(behind) - reading.sent)
            if len(behind) > TURNS:
                exchange.close()
                return False
            for k in range(3):
                exchange.row(state(robot, robot_ns=1_000_000 * (3 * len(behind) + k)), None, TICK)
            bad.sendall(2048 // len(again) * again)
            assert select.select([flooding.socket], [], [], PATIENCE)[0]
            before = flooding.decoder.offset + flooding.decoder.pending
            is_served = real_turn()
            assert 0 < flooding.decoder.offset + flooding.decoder.pending - before <= 4096
            return is_served

        monkeypatch.setattr(ports, "turn", turn)
        process.run()
        with good.socket:
            rows = [event.value["tm"] for event in good.read(2 + 3 * TURNS) if isinstance(event, Sample)]
    assert max(behind) == 0
    assert rows == list(range(3, 3 * TURNS + 3))
    assert flooding.refused > 100 * TURNS if kind == "wrong" else not flooding.refused
    assert asked.count("CommandRequest") == (0 if kind == "wrong" else TURNS)
    assert asked.count("Report") == (1 if kind == "wrong" else 0)


@pytest.mark.parametrize("port", ["yumi_right", "parameters", "fused"])
def test_stop_from_any_client_on_any_port(running: Running, port: str) -> None:
    with LabCommClient(port=running.ports[port]) as client:
        client.stop()
        until(lambda: running.exchange.poll() or running.exchange.arbiter.stopped)
    assert running.exchange.arbiter.stopped.startswith("labcomm 127.0.0.1:")


def test_what_is_no_command_and_what_is_no_labcomm_are_events(running: Running, robot: Robot) -> None:
    told: list[str] = []
    running.exchange.begin(lambda text, *_: told.append(text))

    def said(words: str) -> bool:
        running.exchange.arbiter._answered.clear()  # report each message immediately
        running.exchange.poll()
        return any(text.startswith("labcomm: ") and words in text for text in told)

    with socket.create_connection(("127.0.0.1", running.ports[robot.name])) as one:
        types, encoder = RowTypes(robot.abb_axes), Encoder("2014v1")
        value = {name: 7 * [0.0] for name in ("pos", "vel", "trq")}
        one.sendall(encoder.version() + encoder.define(types.sent) + encoder.data(types.sent, {"tm": 1, **value}))
        until(lambda: said("got a sample of type 'robot_row'"))
        one.sendall(64 * b"\xff")
        until(lambda: said("was closed, offset"))
    assert not running.exchange.arbiter.obeyed[robot.name]


def test_options() -> None:
    left, right = robots.load("yumi_left"), robots.load("yumi_right")
    options = labcomm_options([left, right])
    assert [arm["port"] for arm in options["arms"].values()] == [7511, 7512]
    assert (options["host"], options["parameters"], options["fused"]) == ("127.0.0.1", 7513, 7514)
    assert [arm["port"] for arm in labcomm_options([right])["arms"].values()] == [7512]
    six = labcomm_options([robots.load("irb2400")])
    assert (six["fused"], six["arms"]["irb2400"]["port"]) == (None, 7511)
    text = "sample struct { double pos[7]; } state;"
    assert labcomm_options([left], types=text, follows_client=True)["types"] == text
    with pytest.raises(LabCommError, match="to be a struct"):
        labcomm_options([left], types="sample int a;")
    with pytest.raises(UnknownName, match="dialect"):
        labcomm_options([left], dialect="2015")
    with pytest.raises(ConfigError, match="each of 1 arms"):
        labcomm_options([left], ports=[1, 2])


def test_it_is_one_of_the_bridge_s_servers(robot: Robot) -> None:
    exchange = Hub([robot], ["labcomm"])
    text = "sample struct { long tm; float pos[_]; } where; sample struct { float pos[7]; } there;"
    options = labcomm_options([robot], ports=[0], parameters=0, fused=None, types=text)
    with Servers(exchange, {"labcomm": server_command("labcomm", options)}) as servers:
        where = servers.ready()
        assert [text.partition(" ")[2] for text in where] == [f"(labcomm, {robot.name})", "(labcomm, parameters)"]
        types = RowTypes(robot.abb_axes, text=text)
        with LabCommClient(port=int(where[0].partition(" ")[0].rpartition(":")[2]), types=types) as client:
            rows: list[Row] = []
            until(lambda: exchange.row(state(robot), None, TICK) or rows.extend(client.rows(0.0)) or rows)
    assert np.allclose(rows[0].q, robot.q_home, rtol=0, atol=1e-6)


def test_an_arm_is_taken_as_it_stands_in_the_row() -> None:
    left, right = robots.load("yumi_left"), robots.load("yumi_right")
    schema, q = RowSchema.of([left, right]), np.arange(7.0)
    writer = RowWriter(schema)

    def written(robot: Robot, t: float) -> Any:
        now = State(t=t, dt=0.004, q=q, qd=q, tau=q, robot=robot.name)
        return read_row(schema, writer.row(now, None, TICK, 1)).values

    values = written(right, 1.5)
    assert arm_in(values, left.name) is None
    assert arm_in(written(left, 1.7e308), left.name) is None
    values = written(left, 1.5)
    held: Any = arm_in(values, right.name)
    assert not values[f"{right.name}.fresh"]
    assert (held.name, held.row.tm, held.row.q.tolist()) == (right.name, 1500, q.tolist())
