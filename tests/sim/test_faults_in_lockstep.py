"""The bridge and the simulated controller under every fault: the arm stays within limits, and the log is complete.

Both run in one thread without sockets: whenever the bridge waits, the controller has a cycle.
"""

from __future__ import annotations

import time
from collections import deque
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from armlab import bridge, robots
from armlab.bridge.control.arm import Surplus
from armlab.bridge.control.realtime import Waiting
from armlab.bridge.net.sockets import Arrival, Port
from armlab.sim.controller import Controller
from armlab.sim.fault_rates import FaultRates
from armlab.sim.faults import Faults
from armlab.sim.lagging import LaggingArm
from armlab.sim.settings import Settings
from armlab.state import Command, State
from armlab.wire.egm import EgmCodec, Packet, RobotSideCodec

ROBOT = robots.load("yumi_right")
MIDDLE = (ROBOT.q_min + ROBOT.q_max) / 2
PERIOD = 0.012096  # SampleRate 12: three times as fast to test as 4
SECONDS, UNTIL = 60.0, 57.0  # the last seconds are clean
SHARES = (0.01, 0.1, 0.5)
FAULTS: dict[str, Any] = {
    "loss": lambda p: FaultRates(loss=p, until=UNTIL),
    "burst": lambda p: FaultRates(loss=p, burst=10, until=UNTIL),
    "duplicate": lambda p: FaultRates(duplicate=p, until=UNTIL),
    "reorder": lambda p: FaultRates(reorder=p, until=UNTIL),
    "corrupt": lambda p: FaultRates(corrupt=p, until=UNTIL),
    "delay": lambda p: FaultRates(delay=(p * PERIOD, 0.5 * PERIOD), until=UNTIL),
    "pause": lambda p: FaultRates(pause=(5.0, p * SECONDS), until=UNTIL),
}


class Wire:
    """The way between bridge and controller, with faults in both directions."""

    def __init__(self, outgoing: FaultRates, incoming: FaultRates) -> None:
        codec = RobotSideCodec(ROBOT, extension=True)
        self.controller = Controller(LaggingArm(ROBOT, PERIOD, MIDDLE), codec, Settings(period=PERIOD))
        self._out, self._in = Faults(outgoing, [7, 1], PERIOD), Faults(incoming, [7, 2], PERIOD)
        self._packets, self._replies = deque[bytes](), list[tuple[int, bytes]]()
        self._eyes, self.depth = EgmCodec(ROBOT, extension=True), -1

    def receive(self) -> Arrival | None:
        if not self._packets:
            return None
        data = self._packets.popleft()
        packet = self._eyes.decode(data)
        self.depth = packet.queue_depth if isinstance(packet, Packet) else self.depth
        return Arrival(data, ("127.0.0.1", 1), time.monotonic_ns())

    def send(self, data: bytes) -> bool:
        self._replies.append((0, data))
        return True

    def next(self) -> tuple[int, Arrival] | None:
        """Run cycles until a packet comes through."""
        controller = self.controller
        for _ in range(10_000):
            arrival = self.receive()
            if arrival is not None:
                return 0, arrival
            for _, data in self._in.through(self._replies, controller.uptime):
                controller.accept(data)
            self._replies.clear()
            packet = controller.packet()
            sent = self._out.through([(controller.cycle, packet)] if packet else [], controller.uptime)
            self._packets.extend(data for _, data in sent)
            controller.advance()
        return None


def sway(state: State) -> Command:
    """Velocities, so that time that was lost is no jump; far from the limits, because the last speed goes on."""
    goal = MIDDLE + 0.2 * np.sin(2.0 * state.t) ** 2
    return Command(qd=0.4 * np.sin(4.0 * state.t) + 0.5 * (goal - state.q))


@pytest.fixture
def play(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Give a function that runs bridge and controller against each other."""

    leaves_out = Surplus.leaves_out

    def run(outgoing: FaultRates, incoming: FaultRates, seconds: float) -> tuple[Any, Controller]:
        wire = Wire(outgoing, incoming)
        monkeypatch.setattr(Waiting, "next", lambda waiting, seconds: wire.next())
        monkeypatch.setattr(Port, "receive", lambda port: wire.receive())
        monkeypatch.setattr(Port, "send", lambda port, data, to: wire.send(data))

        # a bridge in lockstep never leaves out a reply, because a robot would wait for it; this one does not wait
        def with_wire(surplus: Surplus, depth: int, period: float) -> bool:
            return leaves_out(surplus, wire.depth, period)

        monkeypatch.setattr(Surplus, "leaves_out", with_wire)
        with bridge.connect("egm://127.0.0.1:0", ROBOT, extension=True, clock="robot") as link:
            return link.run(sway, seconds=seconds, wait="block"), wire.controller

    return run


def check(found: Any, controller: Controller) -> None:
    table, counted = found.table, found.statistics
    assert found.reason == "the time is up"
    assert not controller.dead
    assert counted["replies"] + counted["overtaken"] <= counted["packets"] == len(table), "every packet has its row"
    q, sent = table["q"], table["q_sent"][np.isfinite(table["q_sent"]).all(axis=1)]
    assert ((q > ROBOT.q_min) & (q < ROBOT.q_max)).all()
    assert np.abs(np.diff(sent, axis=0)).max() <= ROBOT.qd_max.max() * 1.5 * PERIOD
    assert np.ptp(sent, axis=0).min() > 0.1, "it moved"


@pytest.mark.parametrize("way", ["out", "in"])
@pytest.mark.parametrize("fault", FAULTS)
def test_a_reference_is_one_cycle_old_again_after_faults(play: Any, fault: str, way: str) -> None:
    """Overtaken packets get no reply; for what faults of the replies leave in the queue, replies are left out."""
    rates = replace(FAULTS[fault](0.5), until=1.5, pause=(0.5, 0.5) if fault == "pause" else (0.0, 0.0))
    found, controller = play(*((rates, FaultRates()) if way == "out" else (FaultRates(), rates)), 4.0)
    assert found.reason == "the time is up"
    assert controller.statistics.last_age == 1
    assert len(controller.inbox) <= 1


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS)
def test_every_fault_for_a_minute(play: Any, fault: str) -> None:
    """1, 10 and 50 % of the datagrams in both directions; all seven faults together take half a minute."""
    for share in SHARES:
        check(*play(FAULTS[fault](share), FAULTS[fault](share), SECONDS))
