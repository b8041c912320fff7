"""The UDP client of a simulated controller, the faults of its datagrams, and the ranges of all options."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.sim.arm.arm import SimulatedArm
from armlab.sim.arm.truth import synthetic_truth
from armlab.sim.controller.channel import CORRUPTED, Faults, UdpClient
from armlab.sim.controller.controller import SimulatedController
from armlab.sim.controller.settings import ControllerSettings, FaultRates
from armlab.wire.egm import Drop, EgmCodec
from armlab.wire.egm.robot_side import RobotSideCodec

ROBOT = robots.load("yumi_right")
MakePeer = Callable[..., Any]


def channel(port: int, host: str = "127.0.0.1", seed: int = 0) -> UdpClient:
    arm = SimulatedArm(ROBOT, synthetic_truth(ROBOT), seed=seed)
    return UdpClient(SimulatedController(arm, RobotSideCodec(ROBOT, extension=True), ControllerSettings()), host, port)


def cycles(client: UdpClient, count: int) -> None:
    for _ in range(count):
        client.prepare()
        client.send()
        client.controller.advance()
        assert client.wait(5.0, lambda: True)


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_one_reply_per_packet_of_age_one(make_peer: MakePeer) -> None:
    peer = make_peer(ROBOT)
    client = channel(peer.port)
    cycles(client, 280)
    statistics = client.controller.statistics
    assert statistics.counts["replies"] == statistics.counts["packets"] == 280
    assert statistics.counts["starved"] == 0
    assert set(statistics.age) == {1}
    trips = statistics.as_dict()["round_trip_us"]
    assert 0 < trips["p50"] < 1e5
    client.close()


def test_waiting_skips_what_is_no_answer(make_peer: MakePeer) -> None:
    def answer(k: int, packet: Any, reply: bytes) -> list[bytes]:
        return [b"garbage", reply, b""] if k % 3 == 0 else [reply]

    client = channel(make_peer(ROBOT, answer).port)
    cycles(client, 60)
    client.drain()
    statistics = client.controller.statistics
    assert statistics.counts["replies"] == 60
    assert sum(statistics.drops.values()) >= 39
    client.close()


def test_a_flood_does_not_outlast_the_patience(make_peer: MakePeer) -> None:
    """Endless garbage: each read also checks the clock and the parent process."""
    client = channel(make_peer(ROBOT, lambda k, packet, reply: []).port)
    client._get = lambda: b"garbage"  # type: ignore[method-assign]
    client.prepare()
    client.send()
    assert not client.wait(0.05, lambda: True)
    assert not client.wait(60.0, lambda: False)
    client.close()


def test_replies_that_come_between_sessions_do_not_wait_for_the_next(make_peer: MakePeer) -> None:
    client = channel(make_peer(ROBOT, lambda k, packet, reply: [reply, reply]).port)
    cycles(client, 1)
    client.controller.lose_peer()
    drops = client.controller.statistics.drops
    for _ in range(40):
        cycles(client, 1)
        if drops["not guiding"]:
            break
        time.sleep(0.01)
    assert drops["not guiding"] == 1
    client.close()


def test_delayed_packets_leave_newest_first() -> None:
    """This way a peer answers only one of them, however fast it reads."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server:
        server.bind(("127.0.0.1", 0))
        client = channel(server.getsockname()[1])
        client._outgoing = SimpleNamespace(through=lambda _, now: [(1, b"old"), (3, b"new"), (2, b"middle")])  # type: ignore[assignment]
        client.send()
        assert [server.recv(100) for _ in range(3)] == [b"new", b"middle", b"old"]
        client.close()


def test_a_port_that_is_bound_late_is_served(make_peer: MakePeer) -> None:
    port = free_port()
    client = channel(port)
    client.prepare()
    client.send()
    looks: list[Any] = []

    def alive() -> bool:
        if len(looks) == 3:
            make_peer(ROBOT, None, port)
        looks.append(0)
        return True

    assert client.wait(20.0, alive)
    assert client.controller.statistics.counts["refused"] >= 1
    assert client.controller.statistics.counts["replies"] == 1
    client.close()


def test_a_flood_does_not_hold_the_cycle_up() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server:
        server.bind(("127.0.0.1", 0))
        client = channel(server.getsockname()[1])
        client.prepare()
        client.send()
        _, address = server.recvfrom(65535)
        for _ in range(150):
            server.sendto(np.random.default_rng(1).bytes(40), address)
        client.drain()
        assert sum(client.controller.statistics.drops.values()) == 64
        client.close()


N = 4000


def outcome(rates: FaultRates, seed: int = 1) -> list[list[tuple[int, bytes]]]:
    faults = Faults(rates, seed, period=0.004)
    return [faults.through([(k, f"datagram {k}".encode())], 0.004 * k) for k in range(N)]


def numbers(rates: FaultRates) -> list[int]:
    return [number for cycle in outcome(rates) for number, _ in cycle]


def test_rates() -> None:
    spread = 4 * np.sqrt(0.1 * 0.9 / N)
    assert 1 - len(numbers(FaultRates(loss=0.1))) / N == pytest.approx(0.1, abs=spread)
    assert len(numbers(FaultRates(duplicate=0.1))) / N - 1 == pytest.approx(0.1, abs=spread)
    assert numbers(FaultRates(corrupt=0.1)).count(CORRUPTED) / N == pytest.approx(0.1, abs=spread)
    swapped = (np.diff(numbers(FaultRates(reorder=0.1))) < 0).mean()
    assert 0.05 < swapped < 0.1 + spread


def waits(rates: FaultRates) -> np.ndarray:
    return np.array([k - number for k, cycle in enumerate(outcome(rates)) for number, _ in cycle])


def test_delay_to_the_nearest_cycle() -> None:
    assert set(waits(FaultRates(delay=(0.0121, 0.0))).tolist()) == {3}
    assert set(waits(FaultRates(delay=(0.0019, 0.0))).tolist()) == {0}
    spread = waits(FaultRates(delay=(0.02, 0.008)))
    assert spread.mean() == pytest.approx(5.0, abs=0.2)
    assert spread.std() == pytest.approx(2.0, abs=0.2)


def test_a_pause_holds_and_then_gives_everything() -> None:
    cycles = outcome(FaultRates(pause=(1.0, 0.4)))
    quiet = [k for k, cycle in enumerate(cycles) if not cycle]
    assert quiet == list(range(250, 350))
    assert sorted(number for number, _ in cycles[350]) == list(range(250, 351))


def test_losses_come_in_bursts_at_the_same_share() -> None:
    kept = np.zeros(N + 1, dtype=bool)
    kept[numbers(FaultRates(loss=0.2, burst=10))] = True
    kept[N] = True
    assert 1 - kept[:N].mean() == pytest.approx(0.2, abs=0.06)
    assert 1 - len(numbers(FaultRates(loss=0.6, burst=10))) / N == pytest.approx(0.6, abs=0.08)
    edges = np.flatnonzero(np.diff(kept.astype(int)))
    runs = np.diff(edges)[::2] if not kept[edges[0] + 1] else np.diff(edges)[1::2]
    assert runs[:-1].min() >= 10


def test_from_until_on_nothing_goes_wrong() -> None:
    rates = FaultRates(loss=0.5, corrupt=0.5, reorder=0.5, delay=(0.01, 0.0), pause=(7.0, 9.0), until=8.0)
    cycles = outcome(rates)
    assert not any(cycles[1760:2000])
    assert cycles[2010:] == [[(k, f"datagram {k}".encode())] for k in range(2010, N)]


def test_corrupted_can_never_be_read() -> None:
    codec = EgmCodec(ROBOT)
    for cycle in outcome(FaultRates(corrupt=1.0))[:300]:
        assert isinstance(codec.decode(cycle[0][1]), Drop)
