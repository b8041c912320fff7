"""Whether something grows, told from what was measured while others used the machine too.

Memory comes from the kernel in steps, and each look at a delay is longer or shorter by chance, so that neither the last
value nor the largest says anything. Of memory it is the median slope of the second half that counts; of descriptors and
threads the median of a while; of delays the least of a while, which others on the machine make no shorter.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

__all__ = ["ARENA", "Finding", "LATER", "MARGIN", "count", "delay", "equal", "growth", "memory"]

ARENA = 2**20
"""Bytes that Python takes from the kernel at once."""

LATER = 1.5
"""Times the least delay of the second quarter, that of the last quarter at most."""

MARGIN = 100e-6
"""s by which the least delay may be longer in any case: what turns of the scheduler take."""

_MOST = 400  # points of a series: a slope for each two of them


class Finding(NamedTuple):
    """One judged quantity: what was found, and what it may be at most."""

    what: str
    unit: str
    found: float
    most: float

    @property
    def is_met(self) -> bool:
        """Whether it is within its bound; NaN is not."""
        return self.found <= self.most

    def __str__(self) -> str:
        verdict = "ok  " if self.is_met else "FAIL"
        return f"{verdict} {self.what}: {self.found:.6g}{self.unit}, at most {self.most:.6g}{self.unit}"


def growth(t: np.ndarray, values: np.ndarray) -> float:
    """Return by how much a series grew in its second half: the median slope between two points (Theil, Sen), times it.

    Parameters
    ----------
    t, values : (N,) times and values. Fewer than four in the second half: NaN.
    """
    half = t >= 0.5 * (t[0] + t[-1]) if len(t) else np.zeros(0, bool)
    t, values = t[half], values[half]
    if len(t) < 4:
        return float("nan")
    step = -(-len(t) // _MOST)
    t, values = t[::step], values[::step]
    first, second = np.triu_indices(len(t), 1)
    slopes = (values[second] - values[first]) / (t[second] - t[first])
    return float(np.median(slopes) * (t[-1] - t[0]))


def memory(what: str, t: np.ndarray, bytes_held: np.ndarray) -> Finding:
    """Judge memory: in half the time it may grow by two of the pieces in which it comes."""
    grown = growth(t, bytes_held)
    return Finding(f"{what}: memory, growth in the second half", " MiB", grown / 2**20, 2 * ARENA / 2**20)


def count(what: str, values: np.ndarray) -> Finding:
    """Judge descriptors or threads: the median of the last quarter is no more than that of the second."""
    before, after = _quarters(values, np.median)
    return Finding(f"{what}, median of the last quarter", "", after, before)


def delay(what: str, seconds: np.ndarray) -> Finding:
    """Judge delays, one for each stretch of time: the least of the last quarter against that of the second."""
    before, after = _quarters(seconds, np.min)
    return Finding(f"{what}, least in the last quarter", " ms", 1e3 * after, 1e3 * (LATER * before + MARGIN))


def equal(what: str, found: float, wanted: float) -> Finding:
    """Judge what must be exactly so."""
    return Finding(f"{what} ({found:.0f} of {wanted:.0f}), difference", "", abs(found - wanted), 0.0)


def _quarters(values: np.ndarray, reduce: Callable[[np.ndarray], Any]) -> tuple[float, float]:
    """Return one number of the second quarter and of the last; NaN for too few."""
    if len(values) < 4:
        return float("nan"), float("nan")
    quarters = np.array_split(np.asarray(values, dtype=float), 4)
    return float(reduce(quarters[1])), float(reduce(quarters[3]))
