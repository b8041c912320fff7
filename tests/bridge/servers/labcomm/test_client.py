"""LabComm client: rows, commands, parameters, a server that closes, and a controller that runs over LabComm."""

from __future__ import annotations

import socket
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from armlab import bridge, robots
from armlab.bridge.servers.labcomm import ArmChannel, LabCommServer, Row
from armlab.bridge.servers.labcomm.client import LabCommClient, LabCommSource, RowCodec, RowPort, far_end
from armlab.bridge.servers.labcomm.rows import RowTypes
from armlab.errors import ConfigError, LinkError, UnknownName
from armlab.log import Column
from armlab.robots import Robot
from armlab.state import Command, State
from armlab.wire.egm import Codec, Drop, Packet, Reference
from armlab.wire.labcomm import Decoder, Encoder, Sample
from armlab.wire.labcomm.types import PRIMS, Array

from ..conftest import PATIENCE, until
from .conftest import Started, row

Start = Callable[..., Started]


def test_rows_and_commands(start: Start) -> None:
    taken: list[Row] = []
    one = start(ArmChannel("left", 0, lambda name, row, client: taken.append(row)))
    with LabCommClient(port=one.server.ports["left"]) as client:
        until(lambda: one.server.counts["left"]["clients"] == 1)
        assert client.rows(0.0) == []
        one.server.row("left", row(3))
        (got,) = client.rows(PATIENCE)
        assert got.tm == 3
        assert np.array_equal(got.q, row(3).q)
        client.command(Row(3, np.arange(7.0), 0.5 * np.ones(7)))
        until(lambda: taken)
        assert (taken[0].tm, taken[0].q.tolist(), taken[0].tau) == (3, list(range(7)), None)
        assert taken[0].qd.tolist() == [0.5] * 7
        assert [sample.name for sample in client.samples.values()] == ["robot_row"]


def test_a_callback_answers_rows(start: Start) -> None:
    """The callback corresponds to the handler of the original client."""
    one = start(ArmChannel("left", 0, lambda name, command, client: one.server.row("left", row(command.tm + 1))))
    seen: list[int] = []

    def on_row(got: Row) -> Row | None:
        seen.append(got.tm)
        if got.tm == 50:
            one.server.close()
        return got

    with LabCommClient(port=one.server.ports["left"], patience=0.2) as client:
        until(lambda: one.server.counts["left"]["clients"] == 1)
        one.server.row("left", row(0))
        with pytest.raises(LinkError, match="closed the connection"):
            client.run(on_row, reconnects=False)
    assert seen == list(range(51))


def test_a_client_connects_again(start: Start) -> None:
    first = start(ArmChannel("left", 0))
    port = first.server.ports["left"]
    with LabCommClient(port=port) as client:
        first.server.close()
        again = start(ArmChannel("left", port))
        calls: list[int] = []
        client.run(lambda got: calls.append(got.tm), 0.05)
        until(lambda: again.server.counts["left"]["clients"] == 1)
        again.server.row("left", row(2))
        assert [got.tm for got in client.rows(PATIENCE)] == [2]
    assert calls == []


def test_what_goes_wrong_is_a_link_error() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
        with LabCommClient(port=port) as client:
            other, _ = listener.accept()
            other.sendall(b"\xff")
            with pytest.raises(LinkError, match="malformed"):
                client.events(PATIENCE)
            other.close()
        with pytest.raises(UnknownName):
            LabCommClient(port=port, dialect="2015")
    with pytest.raises(LinkError, match="Start the server"):
        LabCommClient(port=port, types=RowTypes(order="chain"), patience=1.0)


def test_a_client_that_is_closed_says_so(start: Start) -> None:
    one = start(ArmChannel("left", 0))
    client = LabCommClient(port=one.server.ports["left"])
    client.close()
    with pytest.raises(LinkError, match="closed by this program"):
        client.rows(0.1)
    with pytest.raises(LinkError, match="closed by this program"):
        client.command(Row(0, np.zeros(7)))


FIELDS = {"pos": Column((7,), "rad"), "trq": Column((7,), "N m")}


def test_the_newest_sample_is_the_reading(start: Start) -> None:
    one = start(ArmChannel("left", 0, order="chain"))
    source = LabCommSource("arm", FIELDS, 0.004, one.server.ports["left"], sample="robot_row")
    assert source.newest() is None
    source.start()
    until(lambda: one.server.counts["left"]["clients"] == 1)
    for tm in (1, 2, 3):
        one.server.row("left", row(tm))
    until(lambda: (source.newest() or [None] * 4)[3] == 2)
    reading: Any = source.newest()
    assert np.array_equal(reading.values["pos"], row(3).q)
    assert np.array_equal(reading.values["trq"], row(3).tau)
    assert (reading.source_ns, reading.gaps) == (3_000_000, 0)
    source.close()


def test_it_connects_again_and_says_what_is_wrong(start: Start) -> None:
    one = start(ArmChannel("left", 0))
    port = one.server.ports["left"]
    source = LabCommSource("arm", FIELDS, 0.004, port)
    source.start()
    until(lambda: one.server.counts["left"]["clients"] == 1)
    one.server.close()
    until(lambda: "closed the connection" in source.problem or "Start the server" in source.problem)
    again = LabCommServer([ArmChannel("left", port)])
    until(lambda: again.counts["left"]["clients"] == 1)
    again.row("left", row(4))
    until(source.newest)
    again.close()
    source.close()


@pytest.mark.parametrize("stamp", [float("nan"), float("inf"), 1e300, "2", "2" * 60_000, [1], None])
def test_a_clock_that_is_no_number_is_told(stamp: Any) -> None:
    source = LabCommSource("arm", {"q": Column((2,), "rad")}, 0.004, 1)
    for value in ({"q": [0.0, 1.0], "t_us": stamp}, {"q": [0.0, 1.0], "tm": stamp}):
        source._take(Sample(64, "row", value, PRIMS["double"]))
        assert source.newest() is None
        assert "at most 64 bits" in source.problem
    source._take(Sample(64, "row", {"q": [0.0, 1.0], "tm": 1.5}, PRIMS["double"]))
    reading: Any = source.newest()
    assert reading.source_ns == 1_500_000


def test_numbers_and_other_samples() -> None:
    listed = Sample(64, "force", [1.0, 2.0], Array((0,), PRIMS["double"]))
    source = LabCommSource("sensor", {"f": Column((2,), "N")}, 0.01, 1, sample="force")
    wrong = LabCommSource("sensor", {"f": Column((3,), "N")}, 0.01, 1, sample="force")
    for each in (source, wrong):
        each._take(listed._replace(name="other"))
        assert (each.newest(), each.problem) == (None, "")
        each._take(listed)
    reading: Any = source.newest()
    assert reading.values["f"].tolist() == [1.0, 2.0]
    assert "shape (3,)" in wrong.problem
    for name, problem in ((None, ""), ("other", "trq in the sample other")):
        missing = LabCommSource("sensor", FIELDS, 0.01, 1, sample=name)
        missing._take(Sample(65, "other", {"pos": [0.0] * 7}, PRIMS["double"]))
        assert missing.newest() is None
        assert problem in missing.problem
        assert bool(missing.problem) == bool(problem)
    with pytest.raises(ConfigError, match="without dots"):
        LabCommSource("a.b", FIELDS, 0.01, 1)


@pytest.fixture(scope="module")
def robot() -> Robot:
    return robots.load("yumi_right")


def test_a_controller_moves_an_arm_over_labcomm(start: Start, robot: Robot) -> None:
    seen: list[State] = []
    commands: list[Row] = []
    now = Row(10_000, np.array(robot.q_home), np.zeros(7), np.zeros(7))

    def take(name: str, command: Row, client: str) -> None:
        nonlocal now
        if command.tm == now.tm and command.q is not None:
            commands.append(command)
            now = now._replace(tm=now.tm + 4, q=command.q)
            one.server.row("right", now)

    def controller(state: State) -> Command:
        seen.append(state)
        q = state.q_start.copy()
        q[0] += 0.05 * (1.0 - np.cos(2.0 * np.pi * state.t))
        return Command(q)

    one = start(ArmChannel("right", 0, take, robot.abb_axes))
    with bridge.connect(f"labcomm://127.0.0.1:{one.server.ports['right']}", robot, clock="robot") as link:
        until(lambda: one.server.counts["right"]["clients"] == 1)
        one.server.row("right", now)
        run = link.run(controller, seconds=0.5)
    assert run.reason == "the time is up"
    assert max(np.abs(command.q - robot.q_home).max() for command in commands) == pytest.approx(0.1, abs=0.01)
    assert np.allclose([state.dt for state in seen], 0.004, rtol=0, atol=1e-9)
    assert run.table["q"].shape[1] == 7
    assert seen[-1].tau_source == "measured"


def test_the_port_gives_rows_as_packets_and_connects_again(robot: Robot, start: Start) -> None:
    types = RowTypes(robot.abb_axes)
    one = start(ArmChannel("right", 0, axes=robot.abb_axes))
    number = one.server.ports["right"]
    port, codec = RowPort("127.0.0.1", number, types), RowCodec(robot, types)
    until(lambda: one.server.counts["right"]["clients"] == 1)
    for tm in (1, 2):
        one.server.row("right", row(tm))
    packets = [packet(port, codec) for _ in range(2)]
    assert [(got.seqno, got.tm_ms) for got in packets] == [(0, 1), (1, 2)]
    assert np.array_equal(packets[0].q, row(1).q)
    assert np.array_equal(packets[0].tau, row(1).tau)
    descriptor = port.fileno()
    one.server.close()
    until(lambda: port.receive() is None and port.errors)
    assert not port.send(b"x", ("127.0.0.1", number))
    again = LabCommServer([ArmChannel("right", number, axes=robot.abb_axes)])
    until(lambda: port.receive() is None and again.counts["right"]["clients"] == 1)
    again.row("right", row(3))
    got = packet(port, codec)
    assert (got.seqno, got.tm_ms, port.fileno()) == (0, 3, descriptor)
    again.row("right", row(4))
    again.row("right", row(5))
    until(lambda: again.lost == 0 and not again._published)
    port.flush()
    port.close()
    again.close()


def packet(port: RowPort, codec: RowCodec) -> Packet:
    arrivals: list[Any] = []
    until(lambda: arrivals.append(port.receive()) or arrivals[-1] is not None)
    got = codec.decode(arrivals[-1].data)
    assert isinstance(got, Packet)
    return got


def test_commands_are_rows_of_the_wire(robot: Robot) -> None:
    codec: Codec = RowCodec(robot, RowTypes(robot.abb_axes))
    codec.reset()
    assert codec.capabilities == {"position", "velocity"}
    raw = codec.encode(Reference(np.arange(7.0), None, None, 3, 2**32 - 1))
    decoder = Decoder("2014v1", require_version=False)
    types = RowTypes(robot.abb_axes)
    event = decoder.feed(Encoder().define(types.accepted) + raw)[-1]
    assert isinstance(event, Sample)
    assert (event.value["tm"], event.value["pos"]) == (-1, [0.0, 1.0, 3.0, 4.0, 5.0, 6.0, 2.0])
    assert isinstance(codec.decode(b"short"), Drop)
    assert isinstance(codec.decode(bytes(8) + b"\xff" * 168), Drop)


def test_urls(robot: Robot, start: Start) -> None:
    one = start(ArmChannel("right", 0))
    number = one.server.ports["right"]
    port, codec = far_end(robot, "127.0.0.1", number, {"order": "chain", "dialect": "2014"})
    assert isinstance(codec, RowCodec)
    port.close()
    for options, error in (
        ({"seed": "1"}, ConfigError),
        ({"order": "up"}, ConfigError),
        ({"dialect": "1"}, UnknownName),
    ):
        with pytest.raises(error):
            far_end(robot, "127.0.0.1", number, options)
    with pytest.raises(ConfigError, match="labcomm://HOST:PORT"):
        bridge.connect("labcomm://host:port", robot)
    one.server.close()
    with pytest.raises(LinkError, match="Start the server"):
        bridge.connect(f"labcomm://127.0.0.1:{number}", robot)
