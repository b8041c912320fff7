"""Seeded faults of a datagram path: loss, delay, duplication, reordering, corruption, pauses."""

from __future__ import annotations

import heapq
from collections.abc import Sequence

import numpy as np

from armlab.sim.fault_rates import FaultRates

__all__ = ["CORRUPTED", "Faults"]

CORRUPTED = -1
"""Number of a datagram that no peer can read."""

_NEVER_VALID = 0x07  # a first byte that no protobuf message has


class Faults:
    """One direction of one path; called once per cycle.

    Parameters
    ----------
    rates : see `FaultRates`.
    seed : of the faults, another one for each direction.
    period : time between two cycles [s].
    """

    def __init__(self, rates: FaultRates, seed: int | Sequence[int], period: float = 0.004032) -> None:
        self._rates, self._period = rates, period
        self._random = np.random.default_rng(seed)
        self._under_way: list[tuple[float, int, tuple[int, bytes]]] = []  # (time when due, order of arrival, item)
        self._order = self._losing = 0
        share, length = rates.loss, rates.burst  # a burst begins so often that the share of lost datagrams is `loss`
        self._begins = share / (length - share * (length - 1)) if share else 0.0

    def through(self, datagrams: list[tuple[int, bytes]], now: float) -> list[tuple[int, bytes]]:
        """Return what comes out in this cycle, the newest entries of `datagrams` before delayed ones.

        Parameters
        ----------
        datagrams : (number, bytes) that go in, in this cycle. A corrupted one comes out with the number `CORRUPTED`.
        now : robot time of this cycle [s].
        """
        rates, draw = self._rates, self._random
        out: list[tuple[int, bytes]] = []
        start, length = rates.pause
        resumes = start + length if start <= now < min(start + length, rates.until) else 0.0
        if now >= rates.until:
            out, datagrams = list(datagrams), []
        for number, data in datagrams:
            begins, twice, swapped, corrupt = draw.random(4) < (
                self._begins,
                rates.duplicate,
                rates.reorder,
                rates.corrupt,
            )
            mean, sigma = rates.delay
            wait = max(0.0, mean + sigma * draw.standard_normal()) + self._period * swapped
            if self._is_lost(bool(begins)):
                continue
            item = (CORRUPTED, self._spoil(data)) if corrupt else (number, data)
            for _ in range(1 + int(twice)):
                if wait >= self._period / 2 or resumes:
                    self._order += 1
                    heapq.heappush(self._under_way, (max(now + wait, resumes), self._order, item))
                else:
                    out.append(item)
        while not resumes and self._under_way and self._under_way[0][0] <= now + self._period / 2:
            out.append(heapq.heappop(self._under_way)[2])
        return out

    def _is_lost(self, begins: bool) -> bool:
        if self._losing == 0 and begins:
            self._losing = self._rates.burst
        if self._losing == 0:
            return False
        self._losing -= 1
        return True

    def _spoil(self, data: bytes) -> bytes:
        """Cut the datagram somewhere and overwrite some bytes, so that it can never be read."""
        spoiled = bytearray(data[: max(1, int(self._random.integers(len(data) + 1)))] or b"\0")
        spoiled[self._random.integers(len(spoiled))] = int(self._random.integers(256))
        spoiled[0] = _NEVER_VALID
        return bytes(spoiled)
