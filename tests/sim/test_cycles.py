"""Whole runs: in lockstep, in real time, and with faults on the way."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from armlab import bridge, robots
from armlab.bridge.control.arm import QueueTrimming
from armlab.bridge.control.limits import Limits
from armlab.bridge.control.realtime import Waiting
from armlab.bridge.net.sockets import Arrival, Port
from armlab.errors import LinkError
from armlab.sim.arm.arm import LaggingArm, SimulatedArm
from armlab.sim.arm.truth import synthetic_truth
from armlab.sim.controller.channel import Faults, UdpClient
from armlab.sim.controller.controller import SimulatedController
from armlab.sim.controller.cycles import Timing, run
from armlab.sim.controller.settings import ControllerSettings, FaultRates
from armlab.state import Command, State
from armlab.wire.egm import EgmCodec, Packet, Reference
from armlab.wire.egm.robot_side import RobotSideCodec

RIGHT, LEFT = robots.load("yumi_right"), robots.load("yumi_left")
MakePeer = Callable[..., Any]


def channel(
    port: int, seed: int = 0, robot: Any = RIGHT, rates: FaultRates | None = None, phase: float = 0.0, **changes: Any
) -> UdpClient:
    settings = ControllerSettings(**changes)
    arm = SimulatedArm(robot, synthetic_truth(robot), period=settings.period, seed=seed)
    controller = SimulatedController(arm, RobotSideCodec(robot, extension=True), settings)
    faults = [Faults(rates, [seed, i], settings.period) if rates else None for i in (0, 1)]
    return UdpClient(controller, "127.0.0.1", port, *faults, phase=phase)


def lockstep(make_peer: MakePeer, seed: int, rates: FaultRates | None = None) -> tuple[str, bytes]:
    """A third of a second in lockstep; return the digest of the packets, and the final state of the arm."""
    peer = make_peer(RIGHT)
    client = channel(peer.port, seed, rates=rates)
    assert run([client], Timing(lockstep=True, seconds=0.33)) == "the time is up"
    steps = np.diff([p.robot_ns for p in peer.packets])
    assert rates is not None or (len(peer.packets), *np.unique(steps)) == (82, 4_032_000), "robot time is exact"
    return peer.digest.hexdigest(), client.controller.arm.sample.q.tobytes()


@pytest.mark.parametrize("rates", [None, FaultRates(loss=0.15, duplicate=0.15, reorder=0.15, corrupt=0.15)])
def test_lockstep_same_seed_same_bytes(make_peer: MakePeer, rates: FaultRates | None) -> None:
    first, second, other = (lockstep(make_peer, seed, rates) for seed in (3, 3, 4))
    assert first[1] == second[1]
    assert other[1] != first[1] or rates is None, "without faults the noise is only measured: the arm moves the same"
    if rates is None:
        assert first[0] == second[0]
        assert other[0] != first[0]


def test_lockstep_gives_a_gone_peer_up(make_peer: MakePeer) -> None:
    peer = make_peer(RIGHT, lambda k, packet, reply: [reply] if k < 50 else [])
    client = channel(peer.port)
    reason = run([client], Timing(lockstep=True, patience=0.02, gone=1.0))
    assert "the peer is gone" in reason
    statistics = client.controller.statistics
    assert statistics.counts["replies"] == 50
    assert client.controller.session > 2, "each time-out is a CommTimeout of the robot"
    assert sum(event.number == 41822 for event in statistics.events) == 1


def test_a_pause_of_the_peer_does_not_move_robot_time(make_peer: MakePeer) -> None:
    """Between two runs the peer is silent: robot time stands still and the session goes on."""

    def answer(k: int, packet: Any, reply: bytes) -> list[bytes]:
        if k == 20:
            time.sleep(0.1)
        return [reply]

    peer = make_peer(RIGHT, answer)
    run([channel(peer.port)], Timing(lockstep=True, seconds=0.2))
    assert [p.seqno for p in peer.packets] == list(range(len(peer.packets)))


def test_it_ends_with_the_process_that_started_it(make_peer: MakePeer) -> None:
    peer, calls = make_peer(RIGHT), []

    def alive() -> bool:
        calls.append(0)
        return len(calls) < 20

    assert "has ended" in run([channel(peer.port)], Timing(lockstep=True), alive=alive)
    assert len(peer.packets) <= 20


def test_a_dead_controller_ends_the_run(make_peer: MakePeer) -> None:
    def answer(k: int, packet: Any, reply: bytes) -> list[bytes]:
        if k < 10:
            return [reply]
        return [EgmCodec(RIGHT).encode(Reference(np.full(7, np.nan), None, None, k, packet.tm_ms))]

    client = channel(make_peer(RIGHT, answer).port)
    assert "10014" in run([client], Timing(lockstep=True, seconds=5.0))
    assert client.controller.dead


def test_two_arms_in_one_process(make_peer: MakePeer) -> None:
    peers = [make_peer(RIGHT), make_peer(LEFT)]
    clients = [channel(peers[0].port), channel(peers[1].port, 1, LEFT)]
    seen: list[UdpClient] = []
    run(clients, Timing(lockstep=True, seconds=0.2), observe=seen.append)
    assert seen[:4] == clients * 2
    times = [[p.robot_ns for p in peer.packets] for peer in peers]
    assert times[0] == times[1]


def test_real_time_keeps_the_period(make_peer: MakePeer) -> None:
    """A cycle is sent or skipped, never early and never twice: whatever the machine does, the counts add up."""
    peer = make_peer(RIGHT)
    client = channel(peer.port)
    begin = time.monotonic()
    assert run([client], Timing(seconds=0.5)) == "the time is up"
    assert time.monotonic() - begin >= 0.5, "real time does not run ahead of the clock"
    statistics = client.controller.statistics
    assert statistics.counts["packets"] + statistics.counts["skipped"] >= 124
    assert max(statistics.queue) <= 1 + statistics.counts["starved"], "only late replies make the queue longer"


class Clock:
    """The clocks of `run`, which advance only while it sleeps or works, so that a busy machine has no effect."""

    def __init__(self) -> None:
        self.now = self.cpu = 0.0

    def monotonic(self) -> float:
        return self.now

    def thread_time(self) -> float:
        return self.cpu

    def sleep(self, seconds: float) -> None:
        self.now += seconds

    def work(self, seconds: float) -> None:
        self.now += seconds
        self.cpu += seconds


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr("armlab.sim.controller.cycles.time", clock)
    return clock


def once(client: UdpClient, seq: int, act: Callable[[float], None], seconds: float) -> Callable[[UdpClient], None]:
    """Return an observer that acts before one packet of a channel."""
    done: list[bool] = []

    def observe(which: UdpClient) -> None:
        if which is client and which.controller.seq == seq and not done:
            done.append(True)
            act(seconds)

    return observe


def test_missed_cycles_are_skipped_not_sent_in_a_burst(make_peer: MakePeer, clock: Clock) -> None:
    peer = make_peer(RIGHT)
    client = channel(peer.port, comm_timeout=60.0)
    run([client], Timing(seconds=0.5), observe=once(client, 50, clock.sleep, 0.05))
    peer.close()
    assert client.controller.statistics.counts["skipped"] >= 10
    gaps = np.diff([p.robot_ns for p in peer.packets]) / 4_032_000
    assert gaps.max() >= 10, "robot time went on while the process slept"
    assert [p.seqno for p in peer.packets] == list(range(len(peer.packets))), "what was not sent has no number"


def test_a_listener_hears_a_stream_in_lockstep_at_the_pace_of_the_robot(make_peer: MakePeer) -> None:
    """It never answers, so there is nothing to wait for; a peer that answers is still waited for."""
    silent = make_peer(RIGHT, lambda k, packet, reply: [])
    begin = time.monotonic()
    assert run([channel(silent.port, program="stream")], Timing(lockstep=True, seconds=0.2)) == "the time is up"
    assert 0.2 <= time.monotonic() - begin < 5.0
    assert [p.seqno for p in silent.packets] == list(range(50))

    def slowly(k: int, packet: Any, reply: bytes) -> list[bytes]:
        time.sleep(0.1 if k == 5 else 0.0)
        return [reply]

    slow = make_peer(RIGHT, slowly)
    client = channel(slow.port, program="stream")
    run([client], Timing(lockstep=True, seconds=0.2))
    assert client.controller.statistics.counts["replies"] == len(slow.packets) == 50


@pytest.mark.slow
def test_what_the_machine_skips_is_told_from_what_the_simulator_skips(make_peer: MakePeer, clock: Clock) -> None:
    """A process that waits, for example for a busy processor, does not count as computing too long."""
    counts = []
    for stall in (clock.sleep, clock.work):
        client = channel(make_peer(RIGHT).port, comm_timeout=60.0)
        run([client], Timing(seconds=1.2), observe=once(client, 270, stall, 0.031))
        found = client.controller.statistics.as_dict()
        counts.append((found["counts"].get("overruns", 0), found["counts"]["skipped"], found["work_us"]["max"]))
        assert found["wake_up_late_us"]["max"] > 20_000, "also the cycles that were late count"
    waited, computed = counts
    assert (waited[0], waited[1]) == (0, computed[1])
    assert computed[0] == computed[1] >= 6
    assert computed[2] > 30_000 > waited[2]


def test_two_arms_share_the_clock_and_keep_their_phase(make_peer: MakePeer, clock: Clock) -> None:
    peers = [make_peer(RIGHT), make_peer(LEFT)]
    clients = [
        channel(peers[0].port, comm_timeout=60.0),
        channel(peers[1].port, 1, LEFT, phase=0.002, comm_timeout=60.0),
    ]
    run(clients, Timing(seconds=0.6), observe=once(clients[0], 40, clock.sleep, 0.2))  # longer than an arm makes up
    assert clock.now >= 0.6
    cycles = [client.controller.cycle for client in clients]
    assert abs(cycles[0] - cycles[1]) <= 1, "also after a stall the robot times agree"
    assert all(client.controller.statistics.counts["skipped"] >= 45 for client in clients)


@pytest.mark.parametrize(
    "rates",
    [FaultRates(delay=(0.01, 0.004)), FaultRates(pause=(0.1, 0.05)), FaultRates(loss=0.3, burst=5)],
)
def test_lockstep_waits_for_no_packet_that_faults_hold_back(make_peer: MakePeer, rates: FaultRates) -> None:
    """With a patience of 60 s, a single wrong wait would hang the test."""
    peer = make_peer(RIGHT)
    for outgoing, incoming in ((True, False), (False, True)):
        client = channel(peer.port)
        client._outgoing = Faults(rates, 5) if outgoing else None
        client._incoming = Faults(rates, 6) if incoming else None
        begin = time.monotonic()
        assert run([client], Timing(lockstep=True, seconds=0.35, patience=60.0)) == "the time is up"
        assert time.monotonic() - begin < 50.0
        assert client.controller.statistics.counts["replies"] > 35


ROBOT = RIGHT
MIDDLE = (ROBOT.q_min + ROBOT.q_max) / 2
PERIOD = 0.012096  # SampleRate 12: three times as fast to test as 4
SECONDS = {0.01: 60.0, 0.1: 30.0, 0.5: 20.0}  # by the share of datagrams; the last three are clean
FAULTS: dict[str, Any] = {
    "loss": lambda p: FaultRates(loss=p),
    "burst": lambda p: FaultRates(loss=p, burst=10),
    "duplicate": lambda p: FaultRates(duplicate=p),
    "reorder": lambda p: FaultRates(reorder=p),
    "corrupt": lambda p: FaultRates(corrupt=p),
    "delay": lambda p: FaultRates(delay=(p * PERIOD, 0.5 * PERIOD)),
    "pause": lambda p: FaultRates(pause=(5.0, 60.0 * p)),
}


class Wire:
    """The link between bridge and controller, with faults in both directions."""

    def __init__(self, outgoing: FaultRates, incoming: FaultRates) -> None:
        codec = RobotSideCodec(ROBOT, extension=True)
        self.controller = SimulatedController(
            LaggingArm(ROBOT, PERIOD, MIDDLE), codec, ControllerSettings(period=PERIOD)
        )
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
    """Command velocities, so that lost time causes no jump; stay far from the limits, as the last speed continues."""
    goal = MIDDLE + 0.2 * np.sin(2.0 * state.t) ** 2
    return Command(qd=0.4 * np.sin(4.0 * state.t) + 0.5 * (goal - state.q))


@pytest.fixture
def play(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return a function that runs bridge and controller against each other."""

    leaves_out = QueueTrimming.leaves_out

    def run(
        outgoing: FaultRates, incoming: FaultRates, seconds: float, limits: Limits | None = None
    ) -> tuple[Any, SimulatedController]:
        wire = Wire(outgoing, incoming)
        monkeypatch.setattr(Waiting, "next", lambda waiting, seconds: wire.next())
        monkeypatch.setattr(Port, "receive", lambda port: wire.receive())
        monkeypatch.setattr(Port, "send", lambda port, data, to: wire.send(data))

        # a bridge in lockstep never skips a reply, because a robot would wait for it; this one does not wait
        def with_wire(trimming: QueueTrimming, depth: int, period: float) -> bool:
            return leaves_out(trimming, wire.depth, period)

        monkeypatch.setattr(QueueTrimming, "leaves_out", with_wire)
        with bridge.connect("egm://127.0.0.1:0", ROBOT, extension=True, clock="robot") as link:
            return link.run(sway, seconds=seconds, wait="block", limits=limits), wire.controller

    return run


def check(found: Any, controller: SimulatedController) -> None:
    table, counted = found.table, found.statistics
    assert found.reason == "the time is up"
    assert not controller.dead
    assert counted["replies"] + counted["overtaken"] <= counted["packets"] == len(table), "every packet has its row"
    q, sent = table["q"], table["q_sent"][np.isfinite(table["q_sent"]).all(axis=1)]
    assert ((q > ROBOT.q_min) & (q < ROBOT.q_max)).all()
    assert np.abs(np.diff(sent, axis=0)).max() <= ROBOT.qd_max.max() * 1.5 * PERIOD
    assert np.ptp(sent, axis=0).min() > 0.1, "it moved"


@pytest.mark.parametrize(
    ("fault", "way"),
    [
        *((fault, "out") for fault in ("loss", "reorder", "delay")),
        *((fault, "in") for fault in ("burst", "duplicate", "corrupt", "pause")),
    ],
)
def test_a_reference_is_one_cycle_old_again_after_faults(play: Any, fault: str, way: str) -> None:
    """Overtaken packets get no reply; replies are skipped to drain the queue that reply faults have filled."""
    rates = replace(FAULTS[fault](0.5), until=0.8, pause=(0.2, 0.5) if fault == "pause" else (0.0, 0.0))
    found, controller = play(*((rates, FaultRates()) if way == "out" else (FaultRates(), rates)), 3.0)
    assert found.reason == "the time is up"
    assert controller.statistics.last_age == 1
    assert len(controller.inbox) <= 1


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS)
def test_every_fault_for_a_minute(play: Any, fault: str) -> None:
    """Faults in 1, 10 and 50 % of the datagrams in both directions; the more faults, the shorter the run.

    When half of all replies are lost, ten at a time, the arm continues at its last speed for up to a second, so a
    larger following error is allowed.
    """
    for share, of_share in SECONDS.items():
        seconds = 60.0 if fault == "pause" else of_share
        limits = Limits.of(ROBOT, following_error=0.5) if (fault, share) == ("burst", 0.5) else None
        rates = replace(FAULTS[fault](share), until=seconds - 3.0)
        check(*play(rates, rates, seconds, limits))


def test_an_arm_that_goes_on_while_replies_are_lost_is_stopped(play: Any) -> None:
    """The bridge sees an arm far from its reference, whether or not the network is the cause."""
    faults = FAULTS["burst"](0.5)
    with pytest.raises(LinkError, match="a following error"):
        play(faults, faults, 60.0)
