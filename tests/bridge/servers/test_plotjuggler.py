"""Datagrams in the format that PlotJuggler reads, sent to this computer and to others."""

from __future__ import annotations

import json
import socket
import time
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.bridge.servers.hub import Hub
from armlab.bridge.servers.plotjuggler import Datagrams, PlotJugglerServer
from armlab.bridge.servers.row import RowSchema, RowWriter
from armlab.bridge.servers.supervisor import Servers, server_command
from armlab.errors import ConfigError, LinkError, UnknownName
from armlab.log import Column, Tick
from armlab.state import Command, State

ARMS = [robots.load("yumi_left"), robots.load("yumi_right")]
OPTIONS = {"host": "127.0.0.1", "to": "127.0.0.1", "port": 9870, "fields": None}
PATIENCE = 20.0  # s; only a test that fails waits so long


def state(number: float = 0.0, **fields: Any) -> State:
    q = np.full(7, number)
    return State(t=1.5, dt=0.004, q=q, qd=q, tau=q, robot="yumi_left", q_start=q, **fields)


def row(schema: RowSchema, now: State, command: Command | None = None) -> bytes:
    return RowWriter(schema).row(now, command, Tick(0, -1, 1_700_000_000_250_000_000, 0, -1, 0), 0)


def test_golden_datagram() -> None:
    schema = RowSchema.of(ARMS)
    data = Datagrams(schema, ["q", "wrench", "utilization"]).datagram(row(schema, state(0.5)))
    assert data == (
        b'{"timestamp":1700000000.25,"yumi_left":{"q":{"1":0.5,"2":0.5,"3":0.5,"4":0.5,"5":0.5,"6":0.5,"7":0.5},'
        b'"wrench":{"1":null,"2":null,"3":null,"4":null,"5":null,"6":null},"utilization":null}}'
    )


def test_sources_are_beside_the_arms() -> None:
    schema = RowSchema.of(ARMS, {"force": {"f": Column((2,), "N")}})
    found = json.loads(Datagrams(schema, ["q"]).datagram(row(schema, state())))
    assert found["force"] == {"f": {"1": None, "2": None}, "age": None}


def test_whatever_the_numbers_are_a_datagram_fits_one_packet() -> None:
    longest = -1.2345678901234567e-308
    schema = RowSchema.of(ARMS)
    made = Datagrams(schema)
    assert made.fields[:4] == ["q", "qd", "tau", "wrench"]
    assert len(made.fields) < len(Datagrams(schema, largest=65507).fields) == 11
    data = made.datagram(row(schema, state(longest, wrench=np.full(6, longest))))
    assert b"e-308" in data
    assert len(data) < 1400
    with pytest.raises(ConfigError, match=r"1400 bytes for PlotJuggler .*, but \w+ does not fit\. Choose fewer"):
        Datagrams(schema, ["q", "qd", "tau", "q_ref", "qd_ref", "tau_ref", "q_sent"])
    with pytest.raises(UnknownName, match="Did you mean 'qd'"):
        Datagrams(schema, ["qdd"])


def test_one_datagram_per_row_and_nobody_who_listens_is_no_error() -> None:
    exchange = Hub(ARMS, ["plotjuggler"])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as reader:
        reader.bind(("127.0.0.1", 0))
        reader.settimeout(PATIENCE)
        command = server_command("plotjuggler", {**OPTIONS, "port": reader.getsockname()[1], "fields": ["q"]})
        with Servers(exchange, {"plotjuggler": command}) as servers:
            (where,) = servers.ready(PATIENCE)
            assert where == f"to 127.0.0.1:{reader.getsockname()[1]} (plotjuggler: q)"
            for k in range(100):
                exchange.row(state(k), None, Tick(k, -1, k, 0, -1, 0))
            got = [json.loads(reader.recv(65536))["yumi_left"]["q"]["7"] for _ in range(100)]
            assert got == list(range(100))
            (counted,) = exchange.summary()["servers"]["plotjuggler"]["clients"].values()
            assert counted == (100, 0)
            reader.close()
            end, refused = time.monotonic() + PATIENCE, 0
            while not refused:
                assert time.monotonic() < end, "the system reported no refused datagram"
                for k in range(10):
                    exchange.row(state(k), None, Tick(k, -1, k, 0, -1, 0))
                ((_, refused),) = exchange.summary()["servers"]["plotjuggler"]["clients"].values()
            assert servers.dead == set()


def test_another_computer_only_where_the_cell_is_opened() -> None:
    with socket.socket() as nobody, pytest.raises(ConfigError, match="Expected --listen plotjuggler=ADDRESS"):
        PlotJugglerServer(nobody, {**OPTIONS, "to": "192.0.2.1"})
    with socket.socket() as nobody, pytest.raises(ConfigError, match="Expected an IPv4 address"):
        PlotJugglerServer(nobody, {**OPTIONS, "to": "300.0.0.1"})


def test_arms_beside_each_other() -> None:
    schema = RowSchema.of(ARMS)
    made, writer = Datagrams(schema, ["q"]), RowWriter(schema)
    for k, robot in enumerate(["yumi_left", "yumi_right", "yumi_left"]):
        now = State(t=1.5, dt=0.004, q=np.full(7, k), qd=np.zeros(7), tau=np.zeros(7), robot=robot)
        found = json.loads(made.datagram(writer.row(now, None, Tick(k, -1, k, 1 + k, -1, 0), 0)))
        assert found == {"timestamp": 1e-9 * k, robot: {"q": {str(joint): k for joint in range(1, 8)}}}
    with pytest.raises(LinkError, match="Expected a row of schema"):
        made.datagram(row(RowSchema.of(ARMS[:1]), state()))
