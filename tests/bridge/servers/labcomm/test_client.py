"""A client: rows, commands, parameters, and a server that goes."""

from __future__ import annotations

import socket
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from armlab.bridge.servers.labcomm import ArmChannel, LabCommServer, ParameterChannel, Row, RowTypes
from armlab.bridge.servers.labcomm.client import LabCommClient, LabCommSource, connected
from armlab.errors import ConfigError, LabCommError, LinkError, UnknownName
from armlab.log import Column
from armlab.wire.labcomm import Sample, parse_lc
from armlab.wire.labcomm.types import Definition, Prim, Version

from .conftest import PATIENCE, Started, row, until

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
    """The handler of the ancestor's client: called with a row, its answer is sent."""
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


def test_parameters_by_name(start: Start) -> None:
    one = start(ParameterChannel({"gain": 0.5}, 0))
    (gain,) = parse_lc("sample double gain;")
    with LabCommClient(port=one.server.ports["parameters"], dialect="2014") as client:
        client.define(gain)
        events = []
        while len(events) < 3:
            events += client.events(PATIENCE)
        assert [type(event) for event in events] == [Version, Definition, Sample]
        client.send(gain, 0.25)
        assert client.events(PATIENCE)[0].value == 0.25
        with pytest.raises(LabCommError, match="gain: a double expected"):
            client.send(gain, "much")


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
    with pytest.raises(LinkError, match="Start it"):
        LabCommClient(port=port, types=RowTypes(order="chain"), patience=1.0)
    with pytest.raises(LinkError, match="Start it"):
        connected("127.0.0.1", port, 1.0)


def test_a_client_that_is_closed_says_so(start: Start) -> None:
    one = start(ArmChannel("left", 0))
    client = LabCommClient(port=one.server.ports["left"])
    client.close()
    with pytest.raises(LinkError, match="closed here"):
        client.rows(0.1)
    with pytest.raises(LinkError, match="closed here"):
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
    until(lambda: "closed the connection" in source.problem or "Start it" in source.problem)
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
        source._take(Sample(64, "row", value, Prim("double")))
        assert source.newest() is None
        assert "at most 64 bits" in source.problem
    source._take(Sample(64, "row", {"q": [0.0, 1.0], "tm": 1.5}, Prim("double")))
    reading: Any = source.newest()
    assert reading.source_ns == 1_500_000


def test_numbers_and_other_samples(start: Start) -> None:
    one = start(ParameterChannel({"force": [1.0, 2.0], "other": 3.0}, 0, mode="all"))
    port = one.server.ports["parameters"]
    source = LabCommSource("sensor", {"f": Column((2,), "N")}, 0.01, port, sample="force")
    wrong = LabCommSource("sensor", {"f": Column((3,), "N")}, 0.01, port, sample="force")
    missing = LabCommSource("sensor", FIELDS, 0.01, port, sample="other")
    for each in (source, wrong, missing):
        each.start()
    until(lambda: source.newest() and wrong.problem and missing.problem)
    for each in (source, wrong, missing):
        each.close()
    reading: Any = source.newest()
    assert reading.values["f"].tolist() == [1.0, 2.0]
    assert "shape (3,)" in wrong.problem
    assert "trq" in missing.problem
    with pytest.raises(ConfigError, match="without dots"):
        LabCommSource("a.b", FIELDS, 0.01, port)
