"""Clients of a remote bridge over Zenoh: a controller that runs on its rows, and a viewer."""

from __future__ import annotations

import struct
import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from armlab import bridge, robots
from armlab.bridge.servers.messages import CommandRequest, SetRequest, Stop, Subscribe
from armlab.bridge.servers.row import Row, RowSchema, beginning
from armlab.bridge.servers.status import Watch
from armlab.bridge.servers.zenoh.feed import ZenohCodec, ZenohFeed, ZenohPort, robots_at
from armlab.bridge.servers.zenoh.messages import checksum, key
from armlab.bridge.servers.zenoh.session import LabAddress, close_session
from armlab.errors import ConfigError, LinkError, UnknownName
from armlab.robots import Robot
from armlab.state import Command, State
from armlab.wire.egm import Codec, Drop, Packet, Reference

from ....processes import free_port
from ..conftest import PATIENCE, until
from .conftest import Running, Wire

Start = Callable[..., Running]


class Arm:
    """Arm behind a Zenoh server in lockstep: it follows each command, then sends the next row."""

    def __init__(self, one: Running) -> None:
        self.one, self.q = one, np.array(one.robot.q_home)
        self.asked: list[Any] = []
        self.over = threading.Event()
        self.thread = threading.Thread(target=self.run)
        self.thread.start()

    def run(self) -> None:
        looks = 20
        while not self.over.is_set():
            state = self.one.row(q=self.q, motors=1, mci=3, rapid=2, seq=self.one.tick, q_sent=self.q)
            for _ in range(looks):
                command: Any = self.one.exchange.arbiter(state)
                if command is not None and (not self.asked or not np.array_equal(command.q, self.q)):
                    self.q = command.q
                    self.asked.append(command)
                    looks = 20
                    break
                self.over.wait(0.001)
            else:
                looks = max(looks // 2, 1)  # it rests

    def close(self) -> None:
        self.over.set()
        self.thread.join()


def test_a_controller_moves_an_arm_over_zenoh(start: Start, robot: Robot) -> None:
    one = start()
    seen: list[State] = []

    def controller(state: State) -> Command:
        seen.append(state)
        q = state.q_start.copy()
        q[0] += 0.025 * (1.0 - np.cos(4.0 * np.pi * state.t))
        return Command(q)

    arm = Arm(one)
    try:
        with bridge.connect(f"zenoh://127.0.0.1:{one.options['port']}/lab1", robot, clock="robot") as link:
            run = link.run(controller, seconds=0.25)
    finally:
        arm.close()
    assert run.reason == "the time is up"
    assert max(np.abs(command.q - robot.q_home).max() for command in arm.asked) == pytest.approx(0.05, abs=0.01)
    assert all(command.qd is not None for command in arm.asked[1:])
    assert seen[-1].mci == 3


def test_the_port_gives_rows_as_packets_also_after_a_restart(start: Start, robot: Robot) -> None:
    number = free_port()
    one = start(number)
    port = ZenohPort(robot, LabAddress("127.0.0.1", number, "lab1"))
    codec: Codec = ZenohCodec(robot, port.schema)
    codec.reset()
    assert codec.capabilities == {"position", "velocity"}
    assert packet(one, port, codec).seqno == 0
    assert port.gaps.rows >= 1  # further rows were sent if the first took long
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
        if arrivals[-1] is None and not one.server._arms[one.robot.name].rows["live"].wanted:
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
    port = ZenohPort(robot, LabAddress("127.0.0.1", one.options["port"], "lab1"))
    codec = ZenohCodec(robot, port.schema)
    session, whole = one.server._session, bytes(port.schema.size)
    where, got = key("lab1", robot.name, "live"), list[Any]()

    def dropped(**attached: bytes) -> bool:
        session.put(where, whole, **attached)
        got.append(port.receive())
        return got[-1] is not None

    until(lambda: dropped(attachment=checksum(whole[1:])))
    until(dropped)
    drops = {codec.decode(arrival.data) for arrival in got if arrival is not None}
    assert drops == {Drop("damaged", "a row with a wrong checksum")}
    port.close()


def test_what_is_no_row_is_dropped(robot: Robot) -> None:
    schema = RowSchema.of([robot])
    codec = ZenohCodec(robot, schema)
    assert isinstance(codec.decode(b"short"), Drop)
    with pytest.raises(UnknownName, match="robot of the bridge"):
        ZenohCodec(robots.load("yumi_left"), schema)
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


@pytest.mark.slow
def test_a_viewer_elsewhere(start: Start, robot: Robot) -> None:
    one = start()
    with ZenohFeed(f"zenoh://127.0.0.1:{one.options['port']}/lab1", patience=1.0) as feed:
        assert feed.cell == "yumi"
        watch, got = Watch(), []
        feed.ask(Subscribe(rate=10.0))

        def seen(kind: Any) -> bool:
            one.row(motors=1, mci=3, rapid=2)
            while feed.wait(0.0):
                got.append(feed.receive())
                watch.take(got[-1])
            return any(
                isinstance(each, Row) if kind is Row else isinstance(each, dict) and each["kind"] == kind
                for each in got
            )

        for kind in ("about", "parameters", Row, "status"):
            until(lambda kind=kind: seen(kind))
        assert watch.arms(0)[0]["arm"] == robot.name
        rows = [each for each in got if isinstance(each, Row)]
        assert np.array_equal(rows[0].values[f"{robot.name}.q"], robot.q_home)
        feed.ask(Subscribe(rate=None))
        feed.ask(SetRequest(values={"gain": 0.25}))
        until(lambda: one.exchange.poll() or one.exchange.parameters.gain == 0.25)
        one.exchange.event("Hello.")
        until(lambda: seen("event"))
        feed.ask(Stop())
        until(lambda: one.exchange.poll() or one.exchange.arbiter.stopped)
        with pytest.raises(ConfigError, match="got CommandRequest"):
            feed.ask(CommandRequest())
        feed.ask(Subscribe(rate=0.0))
        one.exchange.close()
        with pytest.raises(LinkError, match="the bridge has disappeared"):
            all_of(feed)


def all_of(feed: ZenohFeed) -> None:
    for _ in range(10_000):
        feed.receive()


def test_damaged_rows_are_dropped_and_told(start: Start, robot: Robot) -> None:
    one = start()
    with ZenohFeed(f"zenoh://127.0.0.1:{one.options['port']}/lab1") as feed:
        feed.ask(Subscribe(rate=None))
        session, where, data = one.server._session, key("lab1", robot.name, "live"), bytes(feed._schema.size)
        until(lambda: session.put(where, data, attachment=checksum(data[1:])) or feed.damaged > 2)
        until(lambda: session.put(where, data) or feed.damaged > 10)
        said: list[Any] = []
        until(lambda: feed.wait(0.1) and (said.append(feed.receive()) or "4 so far" in said[-1].get("text", "")))
        assert not any(isinstance(each, Row) for each in said)
        assert said[-1]["text"] == "Rows arrived corrupted and were dropped: 4 so far."


def test_texts_that_are_none_are_dropped_and_told(start: Start, robot: Robot) -> None:
    one = start()
    with ZenohFeed(f"zenoh://127.0.0.1:{one.options['port']}/lab1") as feed:
        session, watch, said = one.server._session, Watch(), list[Any]()
        bad = (b"[1", b"5", b"{}", b'{"kind": "event"}', b'{"kind": "about", "schema": "{}"}', b"[" * 100_000)

        def told(text: str) -> bool:
            for where, data in zip(("events", "status", "parameters"), bad[feed.refused % 2 * 3 :], strict=False):
                session.put(key("lab1", robot.name, where), data)
            while feed.wait(0.05):
                said.append(feed.receive())
                watch.take(said[-1])
            return any(text in str(each) for each in said)

        until(lambda: told("Invalid messages were dropped: 8 so far"))
        assert {each["kind"] for each in said} <= {"about", "parameters", "event", "status"}
        feed._is_unsure, before = True, feed.refused
        feed._answered("lab1", robot.name, b"[[[")
        assert feed.refused == before + 1
        one.exchange.event("Hello.")
        until(lambda: told("Hello."))


@pytest.mark.slow
def test_a_bridge_that_comes_again_is_told_from_one_that_restarted(start: Start, robot: Robot) -> None:
    one = start()
    wire, got = Wire(one.options["port"]), list[Any]()

    def heard(bridge: Running, what: Any) -> bool:
        bridge.row()
        while feed.wait(0.0):
            got.append(feed.receive())
        return any(isinstance(each, Row) if what is Row else what in str(each) for each in got)

    with ZenohFeed(f"zenoh://127.0.0.1:{wire.port}/lab1", patience=PATIENCE) as feed:
        feed.ask(Subscribe(rate=None))
        until(lambda: heard(one, Row))
        wire.cut()
        until(lambda: heard(one, "or the connection to it was lost"))
        wire.mend()
        until(lambda: heard(one, "is reachable again, in the same run"))
        got.clear()
        until(lambda: heard(one, Row))
        wire.cut()
        one.exchange.close()
        one.thread.join()
        got.clear()
        again = start(one.options["port"], robot=replace(robots.load("ur5e"), name=robot.name))
        again.tick = 10**6
        while feed.wait(0.0):  # rows of the run that has ended
            feed.receive()
        feed._gaps["another"] = feed._gaps[robot.name]  # of an arm that the restarted cell no longer has
        wire.mend()
        until(lambda: heard(again, "has restarted"))
        got.clear()
        until(lambda: heard(again, Row))
        assert got[-1].values[f"{robot.name}.q"].shape == (6,)
    wire.cut()


def test_rows_that_did_not_come_or_were_not_read_in_time_are_counted(
    start: Start, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("armlab.bridge.servers.zenoh.feed._KEPT", 50)
    one, got = start(), []
    with ZenohFeed(f"zenoh://127.0.0.1:{one.options['port']}/lab1") as feed:
        feed.ask(Subscribe(rate=None))

        def read(what: Any) -> bool:
            one.row()
            while feed.wait(0.0):
                got.append(feed.receive())
            return any(what(each) for each in got)

        until(lambda: read(lambda each: isinstance(each, Row)))
        before = feed.lost  # Zenoh itself may drop rows on a busy machine
        one.tick += 3
        until(lambda: read(lambda each: "so far" in str(each)) and feed.lost >= before + 3)
        last = one.tick - 1
        until(lambda: read(lambda each: isinstance(each, Row) and each.values[f"{robot.name}.tick"] == last))
        before = feed.lost

        def overflows() -> bool:
            for _ in range(100):
                one.row()
            until(lambda: len(feed._messages) >= 50)
            read(lambda each: False)
            return feed.lost > before

        until(overflows)
    ticks = [each.values[f"{robot.name}.tick"] for each in got if isinstance(each, Row)]
    assert feed.lost == ticks[-1] - ticks[0] + 1 - len(ticks) > 3


@pytest.mark.slow
def test_nothing_to_view(start: Start, robot: Robot) -> None:
    port = start().options["port"]
    with pytest.raises(LinkError, match="Expected a robot in the lab 'lab2'"):
        ZenohFeed(f"zenoh://127.0.0.1:{port}/lab2")
    start(port, robot=robots.load("yumi_left"))
    session = LabAddress("127.0.0.1", port).open()
    until(lambda: robots_at(session) == [("lab1", "yumi_left"), ("lab1", robot.name)])
    assert robots_at(session, "lab2") == []
    close_session(session)
    with pytest.raises(ConfigError, match="yumi_left, yumi_right"):
        ZenohFeed(f"zenoh://127.0.0.1:{port}/lab1")
    with ZenohFeed(f"zenoh://127.0.0.1:{port}/lab1", "yumi_left") as feed:
        assert feed.receive()["robots"].keys() == {"yumi_left"}  # type: ignore[union-attr]
