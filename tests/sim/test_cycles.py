"""Whole runs: in lockstep, in real time, and with faults on the way."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.sim.arm.arm import SimulatedArm
from armlab.sim.arm.truth import synthetic_truth
from armlab.sim.controller.channel import Faults, UdpClient
from armlab.sim.controller.controller import SimulatedController
from armlab.sim.controller.cycles import Timing, run
from armlab.sim.controller.settings import ControllerSettings, FaultRates
from armlab.wire.egm import EgmCodec, Reference
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
    reason = run([client], Timing(lockstep=True, patience=0.02, gone=0.1))
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
    """The clocks of `run`, which go on only while it sleeps or works: nothing depends on a busy machine."""

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
    """It never answers, so there is nothing to wait for; a peer that answers is waited for as ever."""
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


def test_what_the_machine_skips_is_told_from_what_the_simulator_skips(make_peer: MakePeer, clock: Clock) -> None:
    """A process that waits, as for a processor that others have, is not one that computes too long."""
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
    """With patience 60 s a single wrong wait would hang the test."""
    peer = make_peer(RIGHT)
    for outgoing, incoming in ((True, False), (False, True)):
        client = channel(peer.port)
        client._outgoing = Faults(rates, 5) if outgoing else None
        client._incoming = Faults(rates, 6) if incoming else None
        begin = time.monotonic()
        assert run([client], Timing(lockstep=True, seconds=0.35, patience=60.0)) == "the time is up"
        assert time.monotonic() - begin < 50.0
        assert client.controller.statistics.counts["replies"] > 35
