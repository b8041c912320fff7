"""A network in virtual time: what it does to datagrams, from when to when."""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass

import numpy as np

__all__ = ["FIRST", "GOOD", "Bad", "Way", "unlucky"]

WIRE = 1e-4  # s that a datagram takes at best
NEVER_VALID = 0x07  # a first byte that no protobuf message has


@dataclass(frozen=True)
class Bad:
    """How often datagrams are lost, late, doubled, overtaken or damaged.

    Attributes
    ----------
    loss, duplicate, reorder, corrupt : shares of all datagrams. burst : losses come this many in a row.
    delay, jitter : mean and standard deviation of the time that they take [s].
    """

    loss: float = 0.0
    burst: int = 1
    duplicate: float = 0.0
    reorder: float = 0.0
    corrupt: float = 0.0
    delay: float = 0.0
    jitter: float = 0.0


GOOD = Bad()
"""Nothing goes wrong."""

FIRST = 6
"""Datagrams of which one is lost, see `unlucky`: an arm that is to stop is not at rest yet."""


class Way:
    """One direction between a robot and the bridge.

    Parameters
    ----------
    bad : what goes wrong. begin, end : virtual time in which it does [s]. seed : another one for each direction.
    period : of the robot [s].

    Attributes
    ----------
    lost : datagrams so far.
    """

    def __init__(self, bad: Bad, begin: float, end: float, seed: list[int], period: float) -> None:
        self._bad, self._begin, self._end, self._period = bad, begin, end, period
        self._random = np.random.default_rng(seed)
        self._under_way: list[tuple[float, int, bytes]] = []
        self._count = self._losing = self.lost = 0

    @property
    def due(self) -> float:
        """When the next datagram arrives [s]."""
        return self._under_way[0][0] if self._under_way else math.inf

    def put(self, now: float, data: bytes) -> None:
        """Send one datagram."""
        if not self._begin <= now < self._end:  # nothing is drawn: a seed tells what happens from the beginning on
            self._deliver(now + WIRE, data)
            return
        bad = self._bad
        begins = bad.loss / (bad.burst - bad.loss * (bad.burst - 1))  # a burst, so often that `loss` is the share
        lost, twice, behind, damaged = self._random.random(4) < (begins, bad.duplicate, bad.reorder, bad.corrupt)
        late = WIRE + max(0.0, bad.delay + bad.jitter * self._random.standard_normal())
        if self._losing or lost:
            self._losing = (self._losing or bad.burst) - 1
            self.lost += 1
            return
        for _ in range(1 + int(twice)):
            spoiled = self._spoil(data) if damaged else data
            self._deliver(now + late + 1.5 * self._period * behind, spoiled)

    def _deliver(self, due: float, data: bytes) -> None:
        self._count += 1
        heapq.heappush(self._under_way, (due, self._count, data))

    def take(self, now: float) -> bytes | None:
        """Return the next datagram that has arrived, None when none has."""
        return heapq.heappop(self._under_way)[2] if self.due <= now else None

    def cut(self) -> None:
        """Lose what is under way."""
        self._under_way.clear()

    def _spoil(self, data: bytes) -> bytes:
        """Cut it somewhere, so that it can never be read."""
        return bytes([NEVER_VALID]) + data[1 : int(self._random.integers(1, len(data)))]


def unlucky(bad: Bad, period: float) -> int:
    """Return the first seed with which both directions lose one of their first datagrams."""
    for seed in range(10_000):
        ways = [Way(bad, 0.0, math.inf, [seed, way], period) for way in (1, 2)]
        for way in ways:
            for k in range(FIRST):
                way.put(k * period, b"..")
        if all(way.lost for way in ways):
            return seed
    raise AssertionError(bad)
