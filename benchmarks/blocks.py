"""Measurement of contenders in alternating blocks of one run, with the results `Figure` and `Table`.

A shared machine can be slow for seconds at a time. The contenders therefore alternate in short blocks, in a new random
order each round, and ratios are computed between blocks of the same round. `loop` and `once` measure the processor time
of all threads, which excludes waiting for a core. `each` measures wall-clock time, which matters for latencies. The
garbage collector stays enabled, as it is for users.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import perf_counter, process_time, sleep
from typing import Any, Literal

import numpy as np

TIMES = ("µs", "ms", "s")
Block = Callable[[], np.ndarray]
"""Function that runs one block and returns seconds per call, one value per sample."""


@dataclass(frozen=True)
class Contender:
    """One implementation of the job.

    Attributes
    ----------
    name, note : as shown in the report. block : measures one block.
    role : "armlab", "peer" or "limit" (a limit of the machine).
    bar : largest allowed ratio. For a peer or limit: armlab's time over its time. For armlab with `over`: armlab's time
        over that of the contender `over`. For armlab without `over`: largest value, if independent of the processor.
    over : name of another contender of the same run.
    """

    name: str
    block: Block
    role: Literal["armlab", "peer", "limit"] = "peer"
    bar: float | None = None
    note: str = ""
    over: str = ""


@dataclass(frozen=True)
class Figure:
    """Measurements of one contender: spread over the blocks [s], and ratio of armlab's time to the contender's.

    Ratios are medians and quartiles of the ratios within each round.

    Attributes
    ----------
    over, multiple : for armlab, the contender to which its target refers, and the median ratio.
    """

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
    over: str = ""
    multiple: float = 1.0

    @property
    def is_met(self) -> bool | None:
        """Whether the target is met; None without a target."""
        if self.bar is None:
            return None
        return (self.ratio if self.role != "armlab" else self.multiple if self.over else self.median) <= self.bar


@dataclass(frozen=True)
class Table:
    """Table of the report. Targets are ratios, because times depend on the machine."""

    title: str
    text: str
    unit: str
    figures: tuple[Figure, ...]
    rounds: int

    def __post_init__(self) -> None:
        """Raise an error if a time has an absolute target."""
        for one in self.figures if self.unit in TIMES else ():
            if one.role == "armlab" and one.bar is not None and not one.over:
                raise ValueError(
                    f"Expected {one.name} to be judged by a ratio, got a target in {self.unit}. Set `over`."
                )


class Disagreement(Exception):
    """Two contenders do not compute the same result, so their times cannot be compared."""


def agree(what: str, got: Any, expected: Any, tolerance: float = 1e-9) -> float:
    """Return the largest difference between two results; raise `Disagreement` above the tolerance or for NaN."""
    got, expected = np.asarray(got, dtype=float), np.asarray(expected, dtype=float)
    error = float(np.max(np.abs(got - expected))) if got.shape == expected.shape else float("nan")
    if not error <= tolerance:
        raise Disagreement(f"{what}: expected agreement to {tolerance:g}, got a difference of {error:g}.")
    return error


def loop(function: Callable[[Any], Any], items: Sequence[Any]) -> Block:
    """Return a block with one call per item; it yields the mean time of a call, including ~20 ns for the loop."""

    def block() -> np.ndarray:
        start = process_time()
        for item in items:
            function(item)
        return np.array([(process_time() - start) / len(items)])

    return block


def once(function: Callable[[], Any], scale: float = 1.0, clock: Callable[[], float] = process_time) -> Block:
    """Return a block with a single call, whose time by `clock` is multiplied by `scale`.

    The result is freed outside the measured time.
    """

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
    """Return a block with one call per item, each with its own time (including ~50 ns for the clock).

    Parameters
    ----------
    begin : called before the block, outside the measured time. period : seconds between the starts of calls, asleep in
        between; 0: none.
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
    """Run every contender `rounds` times alternately; return the samples by contender and round.

    `warm` first runs each contender once; it is unnecessary if a block starts its own processes.
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
    """Reduce each block with `statistic`, and return the spread over the rounds; the first contender is armlab."""
    values = np.array([[statistic(block) for block in blocks] for blocks in samples])
    named = {contender.name: blocks for contender, blocks in zip(contenders, values, strict=True)}
    found = []
    for contender, blocks in zip(contenders, values, strict=True):
        lower, median, upper = np.percentile(blocks, (25, 50, 75))
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio_lower, ratio, ratio_upper = np.percentile(values[0] / blocks, (25, 50, 75))
            multiple = float(np.median(blocks / named[contender.over])) if contender.over else 1.0
        spread = (median, blocks.min(), lower, upper, ratio, ratio_lower, ratio_upper)
        about = contender.name, contender.role, contender.note, contender.bar
        found.append(Figure(*about, *map(float, spread), over=contender.over, multiple=multiple))
    return tuple(found)


def table(title: str, text: str, unit: str, contenders: Sequence[Contender], rounds: int, warm: bool = True) -> Table:
    """Measure the contenders, and return the table of their medians."""
    return Table(title, text, unit, figures(contenders, alternate(contenders, rounds, warm)), rounds)
