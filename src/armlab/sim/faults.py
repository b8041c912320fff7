"""Seeded faults of a datagram path: loss, delay, duplication, reordering, corruption, pauses."""

from __future__ import annotations

import heapq
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armlab.errors import ConfigError

__all__ = ["CORRUPTED", "FaultRates", "Faults"]

CORRUPTED = -1
"""Number of a datagram that no peer can read."""

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
    delay : tuple
        MEAN,SIGMA of a normal delay [s], never below 0, to the nearest cycle.
    pause : tuple
        START,LENGTH [s] in robot time: what is sent meanwhile arrives when the pause is over.
    burst : int
        Losses come this many in a row; `loss` stays the share of all datagrams.
    until : float
        Robot time from which on nothing goes wrong any more [s].

    Raises
    ------
    ConfigError : for a probability outside [0, 1], a time that is negative or no number, or a burst below 1.
    """

    loss: float = 0.0
    duplicate: float = 0.0
    reorder: float = 0.0
    corrupt: float = 0.0
    delay: tuple[float, float] = (0.0, 0.0)
    pause: tuple[float, float] = (0.0, 0.0)
    burst: int = 1
    until: float = math.inf

    def __post_init__(self) -> None:
        """Check the ranges."""
        for name in ("loss", "duplicate", "reorder", "corrupt"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ConfigError(f"Expected {name} between 0 and 1, got {getattr(self, name)}.")
        for name in ("delay", "pause"):
            if not all(0.0 <= value < math.inf for value in getattr(self, name)):
                raise ConfigError(f"Expected two times of at least 0 s for {name}, got {getattr(self, name)}.")
        if not self.until >= 0.0:
            raise ConfigError(f"Expected until of at least 0 s, got {self.until}.")
        if self.burst < 1:
            raise ConfigError(f"Expected a burst of at least 1 datagram, got {self.burst}.")

    @property
    def any(self) -> bool:
        """Whether anything can go wrong at all."""
        rates = self.loss, self.duplicate, self.reorder, self.corrupt, *self.delay, self.pause[1]
        return any(rates)


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
