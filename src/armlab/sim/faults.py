"""Seeded faults of a datagram path: loss, delay, duplication, reordering, corruption."""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from armlab.errors import ConfigError

__all__ = ["FaultRates", "Faults"]

CORRUPTED = -1  # number of a datagram that no peer can read
_NEVER_VALID = 0x07  # a first byte that no protobuf message has


@dataclass(frozen=True)
class FaultRates:
    """How often things go wrong in one direction.

    Attributes
    ----------
    loss : float
        Probability that a datagram is lost.
    duplicate : float
        Probability that it arrives twice.
    reorder : float
        Probability that it arrives one cycle later, behind its successor.
    corrupt : float
        Probability that it arrives damaged, so that nobody can read it.
    delay : float
        Mean delay in cycles, exponentially distributed, rounded down.

    Raises
    ------
    ConfigError : for a probability outside [0, 1] or a negative delay.
    """

    loss: float = 0.0
    duplicate: float = 0.0
    reorder: float = 0.0
    corrupt: float = 0.0
    delay: float = 0.0

    def __post_init__(self) -> None:
        """Check the ranges."""
        for field in fields(self):
            value, top = getattr(self, field.name), 1.0 if field.name != "delay" else 1e4
            if not 0.0 <= value <= top:
                raise ConfigError(f"Expected {field.name} between 0 and {top:g}, got {value}.")

    @property
    def any(self) -> bool:
        """Whether anything can go wrong at all."""
        return any(getattr(self, field.name) for field in fields(self))


class Faults:
    """One direction of one path; called once per cycle.

    Parameters
    ----------
    rates : see `FaultRates`.
    seed : of the faults, another one for each direction.
    """

    def __init__(self, rates: FaultRates, seed: int | Sequence[int]) -> None:
        self._rates = rates
        self._random = np.random.default_rng(seed)
        self._under_way: list[tuple[int, int, tuple[int, bytes]]] = []  # (cycle when due, order of arrival, item)
        self._cycle = self._order = 0

    def through(self, datagrams: list[tuple[int, bytes]]) -> list[tuple[int, bytes]]:
        """Return what comes out in this cycle, the newest entries of `datagrams` before delayed ones.

        Parameters
        ----------
        datagrams : (number, bytes) that go in, in this cycle. A corrupted one comes out with the number `CORRUPTED`.
        """
        rates, draw = self._rates, self._random
        out: list[tuple[int, bytes]] = []
        for number, data in datagrams:
            lost, twice, swapped, corrupt = draw.random(4) < (rates.loss, rates.duplicate, rates.reorder, rates.corrupt)
            delay = int(draw.exponential(rates.delay)) + int(swapped)
            if lost:
                continue
            item = (CORRUPTED, self._spoil(data)) if corrupt else (number, data)
            for _ in range(1 + int(twice)):
                if delay:
                    self._order += 1
                    heapq.heappush(self._under_way, (self._cycle + delay, self._order, item))
                else:
                    out.append(item)
        while self._under_way and self._under_way[0][0] <= self._cycle:
            out.append(heapq.heappop(self._under_way)[2])
        self._cycle += 1
        return out

    def _spoil(self, data: bytes) -> bytes:
        """Cut the datagram somewhere and overwrite some bytes, so that it can never be read."""
        spoiled = bytearray(data[: max(1, int(self._random.integers(len(data) + 1)))] or b"\0")
        spoiled[self._random.integers(len(spoiled))] = int(self._random.integers(256))
        spoiled[0] = _NEVER_VALID
        return bytes(spoiled)
