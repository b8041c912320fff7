"""A controller that runs over Zenoh: the same `Link.run`, on rows instead of packets of EGM."""

from __future__ import annotations

import struct
import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from armlab import bridge, robots
from armlab.bridge.servers.row import RowSchema, beginning
from armlab.bridge.servers.zenoh.keys import key
from armlab.bridge.servers.zenoh.link import ZenohCodec, ZenohPort, far_end
from armlab.bridge.servers.zenoh.rows import checksum
from armlab.bridge.servers.zenoh.session import Address
from armlab.errors import ConfigError, LinkError, UnknownName
from armlab.robots import Robot
from armlab.state import Command, State
from armlab.wire.egm import Codec, Drop, Packet, Reference

from .conftest import Bytes, Running, free_port, until

Start = Callable[..., Running]


class Arm:
    """An arm behind a Zenoh server, in lockstep: it goes where it is told and sends the next row then."""

    def __init__(self, one: Running) -> None:
        self.one, self.q = one, np.array(one.robot.q_home)
        self.asked: list[Any] = []
        self.over = threading.Event()
        self.thread = threading.Thread(target=self.run)
        self.thread.start()

    def run(self) -> None:
        while not self.over.is_set():
            state = self.one.row(q=self.q, motors=1, mci=3, rapid=2, seq=self.one.tick, q_sent=self.q)
            for _ in range(20):
                command: Any = self.one.exchange.arbiter(state)
                if command is not None and (not self.asked or not np.array_equal(command.q, self.q)):
                    self.q = command.q
                    self.asked.append(command)
                    break
                self.over.wait(0.001)

    def close(self) -> None:
        self.over.set()
        self.thread.join()


def test_a_controller_moves_an_arm_over_zenoh(start: Start, robot: Robot) -> None:
    one = start()
    seen: list[State] = []

    def controller(state: State) -> Command:
        seen.append(state)
        q = state.q_start.copy()
        q[0] += 0.05 * (1.0 - np.cos(2.0 * np.pi * state.t))
        return Command(q)

    arm = Arm(one)
    try:
        with bridge.connect(f"zenoh://127.0.0.1:{one.options['port']}/lab1", robot, clock="robot") as link:
            run = link.run(controller, seconds=1.0)
    finally:
        arm.close()
    assert run.reason == "the time is up"
    assert max(np.abs(command.q - robot.q_home).max() for command in arm.asked) == pytest.approx(0.1, abs=0.02)
    assert all(command.qd is not None for command in arm.asked[1:])
    assert seen[-1].mci == 3


def test_the_port_gives_rows_as_packets_also_after_a_restart(start: Start, robot: Robot) -> None:
    number = free_port()
    one = start(number)
    port = ZenohPort(robot, Address("127.0.0.1", number, "lab1"))
    codec: Codec = ZenohCodec(robot, port.schema)
    codec.reset()
    assert codec.capabilities == {"position", "velocity"}
    assert packet(one, port, codec).seqno == 0
    assert port.gaps.rows >= 1  # more were sent when the first took long
    assert port.gaps.lost == 0
    got = packet(one, port, codec)
    assert np.array_equal(got.q, robot.q_home)
    assert (got.tau, got.tau_source, got.tm_ms) == (None, "none", 4 * got.seqno)
    descriptor = port.fileno()
    one.tick = 10**6
    before = port.gaps.rows
    until(lambda: one.row() and port.gaps.rows > before)
    one.exchange.close()
    one.thread.join()
    again = start(number)
    until(lambda: again.row() and port.gaps.starts == 2)
    until(lambda: port.receive() is not None)
    assert port.fileno() == descriptor
    q = np.asarray(robot.q_home)
    until(lambda: port.send(codec.encode(Reference(q, None, None, 0, 0)), ("", 0)) and again.commanded() is not None)
    port.flush()
    port.close()
    assert not port.send(codec.encode(Reference(q, q, None, 0, 0)), ("", 0))
    assert port.errors == 1


def packet(one: Running, port: ZenohPort, codec: Codec) -> Packet:
    arrivals: list[Any] = []

    def came() -> bool:
        arrivals.append(port.receive())
        if arrivals[-1] is None and not one.process._arms[one.robot.name].rows["live"].wanted:
            return False
        if arrivals[-1] is None:
            one.row()
        return arrivals[-1] is not None

    until(came)
    got = codec.decode(arrivals[-1].data)
    assert isinstance(got, Packet)
    return got


def test_a_damaged_row_is_dropped_and_counted_as_such(start: Start, robot: Robot) -> None:
    one = start()
    port = ZenohPort(robot, Address("127.0.0.1", one.options["port"], "lab1"))
    codec = ZenohCodec(robot, port.schema)
    session, whole = one.process._session, bytes(port.schema.size)
    where, got = key("lab1", robot.name, "live"), list[Any]()

    def dropped(**attached: bytes) -> bool:
        session.put(where, whole, **attached)
        got.append(port.receive())
        return got[-1] is not None

    until(lambda: dropped(attachment=checksum(whole[1:])))
    until(dropped)
    drops = {codec.decode(arrival.data) for arrival in got if arrival is not None}
    assert drops == {Drop("damaged", "a row whose checksum is another one")}
    port.close()


def test_what_is_no_row_is_dropped(robot: Robot, start: Start) -> None:
    one = start()
    codec = ZenohCodec(robot, one.exchange.schema)
    assert isinstance(codec.decode(b"short"), Drop)
    with pytest.raises(UnknownName, match="robot of the bridge"):
        ZenohCodec(robots.load("yumi_left"), one.exchange.schema)
    other = RowSchema.read(RowSchema.of([robots.load("irb2400")]).text.replace(b"irb2400", b"yumi_right"))
    with pytest.raises(
        LinkError, match=r"Expected rows with yumi_right.q, float64 of shape \(7,\), got float64 of shape \(6,\)"
    ):
        ZenohCodec(robot, other)


def test_a_time_beyond_all_clocks_is_dropped(robot: Robot) -> None:
    schema = RowSchema.of([robot])
    codec, data = ZenohCodec(robot, schema), bytearray(beginning(schema) + bytes(schema.size - 16))
    for time, wanted in ((1.5, None), (1.7e308, "not finite"), (np.nan, "not finite")):
        struct.pack_into("<d", data, schema.fields[f"{robot.name}.session_t"].offset, time)
        assert getattr(codec.decode(bytes(data)), "reason", None) == wanted


def test_a_row_that_is_too_short_is_handed_over_and_not_counted(start: Start, robot: Robot) -> None:
    one = start()
    port = ZenohPort(robot, Address("127.0.0.1", one.options["port"], "lab1"))
    short = beginning(port.schema)
    port._take(SimpleNamespace(payload=Bytes(short), attachment=Bytes(checksum(short))))
    arrival = port.receive()
    assert arrival is not None
    assert (arrival.data, port.gaps.rows) == (short, 0)
    port.close()


def test_urls(robot: Robot, start: Start) -> None:
    one = start()
    number = one.options["port"]
    with pytest.raises(ConfigError, match="only ca and secret"):
        far_end(robot, "127.0.0.1", number, {"seed": "1"})
    with pytest.raises(ConfigError, match="zenoh://HOST:PORT"):
        bridge.connect("zenoh://host:port", robot)
    with pytest.raises(LinkError, match="See whether the bridge of that robot runs"):
        bridge.connect(f"zenoh://127.0.0.1:{number}/lab2", robot)
