"""The UDP client: what it sends, what it waits for, and that trouble with the socket is counted, not raised."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.errors import LinkError
from armlab.sim.arm.arm import SimulatedArm
from armlab.sim.arm.truth import synthetic_truth
from armlab.sim.controller.channel import UdpClient
from armlab.sim.controller.controller import SimulatedController
from armlab.sim.controller.settings import ControllerSettings
from armlab.wire.egm import RobotSideCodec

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
    cycles(client, 400)
    statistics = client.controller.statistics
    assert statistics.counts["replies"] == statistics.counts["packets"] == 400
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


def test_a_silent_peer_ends_the_waiting(make_peer: MakePeer) -> None:
    client = channel(make_peer(ROBOT, lambda k, packet, reply: []).port)
    client.prepare()
    client.send()
    assert not client.wait(0.05, lambda: True)
    assert not client.wait(60.0, lambda: False), "told to stop"
    client.close()


def test_a_flood_does_not_outlast_the_patience(make_peer: MakePeer) -> None:
    """Garbage without end: each look at it is a look at the clock and at the parent too."""
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
    """So that a peer answers one of them, however fast it looks."""
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


def test_refusal_does_not_raise_in_real_time() -> None:
    client = channel(free_port())
    for _ in range(5):
        assert client.prepare()
        client.send()
        client.drain()
        client.controller.advance()
    assert client.controller.statistics.counts["refused"] >= 1
    client.close()


def test_unknown_host_is_a_sentence() -> None:
    with pytest.raises(LinkError, match="no-such-host"):
        channel(6510, "no-such-host.invalid")


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
