"""One million mutated datagrams between good ones: no exception, no growth, no motion. 17 s."""

from __future__ import annotations

import random
import struct
import sys
import time
from typing import Any

import numpy as np
import pytest

from armlab.bridge.control.limits import Limits
from armlab.bridge.control.session import Session
from armlab.bridge.control.state_machine import Guide
from armlab.bridge.net.sockets import Arrival
from armlab.robots import Robot
from armlab.wire.egm import EgmCodec, Reference
from armlab.wire.egm.robot_side import RobotMessage, RobotSideCodec

DATAGRAMS = 1_000_000
BLOCK = 1000  # of which the slowest is timed
WARM = 300  # blocks until everything that is kept has come up
PERIOD_NS = 4_032_000
SOURCE = ("127.0.0.1", 50000)
BAD = [struct.pack("<d", value) for value in (np.nan, np.inf, 1e308)]


def good_packet(robot: Robot, codec: RobotSideCodec, k: int) -> bytes:
    one = np.ones(robot.n)
    return codec.encode_robot(
        RobotMessage(
            k, 10_000 + 4 * k, robot.q_home, robot.q_home, 10**18 + k * PERIOD_NS, T_frame_tool=np.eye(4),
            wrench_raw=np.ones(6), rapid_data=(1.0, 2.0), rapid_digital=True, tau_reference=one, qd=0 * one, tau=one,
            mono_ns=k * PERIOD_NS,
        )
    )  # fmt: skip


def mutated(rng: random.Random, data: bytes) -> bytes:
    """One of the ways in which a datagram goes wrong."""
    kind, where = rng.randrange(8), rng.randrange(len(data))
    if kind == 0:
        return data[:where]
    if kind == 1:
        return rng.randbytes(where)
    if kind == 2:
        return data[:where] + b"\xff" * rng.randrange(12) + data[where:]
    if kind == 3:
        return data[:where] + data[rng.randrange(len(data)) :]
    if kind == 4:
        return data[:where] + BAD[rng.randrange(3)] + data[where + 8 :]
    if kind == 5:
        return data[:where] + rng.randbytes(rng.randrange(1, 9)) + data[where:]
    flipped = bytearray(data)
    for _ in range(kind - 5):
        flipped[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    return bytes(flipped)


class Reader:
    """What a bridge does with datagrams up to the answer, without the socket."""

    def __init__(self, robot: Robot, told: list[str]) -> None:
        self.codec = EgmCodec(robot, extension=True)
        self.session = Session(self.codec, on_event=lambda text, warn=False: told.append(text))
        self.guide = Guide(robot, Limits.of(robot), capabilities=self.codec.capabilities)
        self.replies = 0

    def hear(self, data: bytes, now_ns: int) -> Any:
        sample = self.session.accept(Arrival(data, SOURCE, now_ns))
        if sample is None:
            return None
        self.guide.observe(sample)
        reply: Any = self.guide.answer(None, 0.004)
        if reply is not None:
            self.replies += 1
            self.codec.encode(Reference(reply.q, reply.qd, reply.tau, self.session.seq, 0))
        return reply


@pytest.mark.slow
def test_a_million_mutated_datagrams(robot: Robot) -> None:
    rng, told = random.Random(1), []
    robot_side = RobotSideCodec(robot, "7", ("qd", "tau"), force=True)
    reader = Reader(robot, told)
    first: Any = reader.hear(good_packet(robot, robot_side, 0), 0)
    assert first is not None
    pool = [mutated(rng, good_packet(robot, robot_side, rng.randrange(1, 900))) for _ in range(20_000)]
    blocks, slowest = 0, 0.0
    for block in range(DATAGRAMS // BLOCK):
        before = time.perf_counter()
        for _ in range(BLOCK):
            data = pool[rng.randrange(len(pool))]
            at = rng.randrange(len(data) + 1)
            reply = reader.hear(data[:at] + rng.randbytes(1) + data[at + 1 :], block * PERIOD_NS + 1)
            assert reply is None or np.abs(reply.q - first.q).max() < 1e-9, "the reference moved"
        slowest = max(slowest, time.perf_counter() - before)
        if block == WARM:
            blocks = sys.getallocatedblocks()
    grown = sys.getallocatedblocks() - blocks
    session = reader.session
    assert session.total_drops + session.received == DATAGRAMS + 1
    assert session.total_drops > 0.5 * DATAGRAMS
    assert grown < 20_000  # objects of Python, bounded by the layouts and sentences of one session
    assert slowest < 5.0  # s for a thousand: nothing hangs
    assert len(told) < 200  # once per kind and session
    assert any(text.startswith("Dropped a datagram from ") for text in told)
    assert reader.replies == session.received
