"""Measuring contenders in alternating blocks of one run, and what is told of it: `Figure` and `Table`.

A shared machine is slow for seconds at a time. Therefore the contenders take turns in short blocks, in a new random
order each round, and ratios are taken between blocks of one round. `loop` and `once` tell processor time of all
threads, which leaves out waiting for a core; `each` tells what the clock on the wall does, as latencies need. The
garbage collector runs as it does for a user.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import perf_counter, process_time, sleep
from typing import Any, Literal

import numpy as np

Block = Callable[[], np.ndarray]
"""Runs one block; returns seconds per call, one value per sample taken."""


@dataclass(frozen=True)
class Contender:
    """One way to do the job.

    Attributes
    ----------
    name, note : as told in the report. block : measures once.
    role : "armlab", "peer" or "limit" (what the machine allows at all).
    bar : for armlab, the most seconds allowed; for a peer, the largest ratio armlab / peer allowed.
    """

    name: str
    block: Block
    role: Literal["armlab", "peer", "limit"] = "peer"
    bar: float | None = None
    note: str = ""


@dataclass(frozen=True)
class Figure:
    """What was measured of one contender: spread over the blocks [s], and ratio of armlab's time to its own."""

    name: str
    role: str
    note: str
    bar: float | None
    median: float
    minimum: float
    lower: float
    upper: float
    ratio: float
    ratio_lower: float
    ratio_upper: float

    @property
    def is_met(self) -> bool | None:
        """Whether the bar is met; None without a bar."""
        if self.bar is None:
            return None
        return (self.median if self.role == "armlab" else self.ratio) <= self.bar


@dataclass(frozen=True)
class Table:
    """One table of the report; `scale` and `unit` tell times, e.g. 1e6 and "µs"."""

    title: str
    text: str
    unit: str
    figures: tuple[Figure, ...]
    rounds: int


class Disagreement(Exception):
    """Two contenders do not compute the same: their times cannot be compared."""


def agree(what: str, got: Any, expected: Any, tolerance: float = 1e-9) -> float:
    """Return the largest difference between two results; raise `Disagreement` above the tolerance or for NaN."""
    got, expected = np.asarray(got, dtype=float), np.asarray(expected, dtype=float)
    error = float(np.max(np.abs(got - expected))) if got.shape == expected.shape else float("nan")
    if not error <= tolerance:
        raise Disagreement(f"{what}: expected agreement to {tolerance:g}, got a difference of {error:g}.")
    return error


def loop(function: Callable[[Any], Any], items: Sequence[Any]) -> Block:
    """Block of one call per item; one sample, the mean time of a call with the loop's own ~20 ns."""

    def block() -> np.ndarray:
        start = process_time()
        for item in items:
            function(item)
        return np.array([(process_time() - start) / len(items)])

    return block


def once(function: Callable[[], Any], scale: float = 1.0, clock: Callable[[], float] = process_time) -> Block:
    """Block of one call, its time by `clock` multiplied by `scale`. The result is freed after the clock stops."""

    def block() -> np.ndarray:
        start = clock()
        result = function()
        seconds = clock() - start
        del result
        return np.array([scale * seconds])

    return block


def each(
    function: Callable[[Any], Any], items: Sequence[Any], begin: Callable[[], Any] | None = None, period: float = 0.0
) -> Block:
    """Block of one call per item, each with its own time (and the clock's ~50 ns).

    Parameters
    ----------
    begin : called before the block, outside the time. period : seconds from call to call, asleep between; 0: none.
    """

    def block() -> np.ndarray:
        if begin is not None:
            begin()
        seconds = np.empty(len(items))
        due = perf_counter()
        for k, item in enumerate(items):
            if period:
                due += period
                sleep(max(0.0, due - perf_counter()))
            start = perf_counter()
            function(item)
            seconds[k] = perf_counter() - start
        return seconds

    return block


def alternate(contenders: Sequence[Contender], rounds: int, warm: bool = True) -> list[list[np.ndarray]]:
    """Run every contender `rounds` times in turns; return samples by contender and round.

    Parameters
    ----------
    warm : run each once before; needless where a block starts processes of its own.
    """
    rng = np.random.default_rng(0)
    samples: list[list[np.ndarray]] = [[] for _ in contenders]
    for contender in contenders if warm else ():
        contender.block()
    for _ in range(rounds):
        for k in rng.permutation(len(contenders)):
            samples[k].append(contenders[k].block())
    return samples


def figures(
    contenders: Sequence[Contender],
    samples: list[list[np.ndarray]],
    statistic: Callable[[np.ndarray], Any] = np.median,
) -> tuple[Figure, ...]:
    """Reduce each block by `statistic`, then tell its spread over the rounds; the first contender is armlab's."""
    values = np.array([[statistic(block) for block in blocks] for blocks in samples])
    medians = np.median(values, axis=1)
    told = []
    for contender, blocks, median in zip(contenders, values, medians, strict=True):
        lower, upper = np.percentile(blocks, (25, 75))
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio_lower, ratio_upper = np.percentile(values[0] / blocks, (25, 75))
            ratio = medians[0] / median
        spread = (median, blocks.min(), lower, upper, ratio, ratio_lower, ratio_upper)
        told.append(
            Figure(contender.name, contender.role, contender.note, contender.bar, *(float(value) for value in spread))
        )
    return tuple(told)


def table(title: str, text: str, unit: str, contenders: Sequence[Contender], rounds: int, warm: bool = True) -> Table:
    """Measure the contenders and return the table of their medians."""
    return Table(title, text, unit, figures(contenders, alternate(contenders, rounds, warm)), rounds)
