"""Detection of growth in measurements on a shared machine.

The kernel allocates memory in steps, and single delays vary randomly, so neither the last nor the largest value is
significant. The tests use the median slope of memory in the second half, medians of descriptors and threads, and minima
of delays, which other load on the machine cannot reduce.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

__all__ = ["ARENA", "Finding", "LATER", "MARGIN", "count", "delay", "equal", "growth", "memory"]

ARENA = 2**20
"""Size of the arenas that Python requests from the kernel [B]."""

LATER = 1.5
"""Largest allowed ratio of the minimum delay in the last quarter to the minimum in the second quarter."""

MARGIN = 100e-6
"""Increase of the minimum delay that is always allowed [s]: a few time slices of the scheduler."""

_MOST = 400  # points of a series; slopes are computed for all pairs


class Finding(NamedTuple):
    """One assessed quantity: its value and its largest allowed value."""

    what: str
    unit: str
    found: float
    most: float

    @property
    def is_met(self) -> bool:
        """Whether the value is within its bound; False for NaN."""
        return self.found <= self.most

    def __str__(self) -> str:
        verdict = "ok  " if self.is_met else "FAIL"
        return f"{verdict} {self.what}: {self.found:.6g}{self.unit}, at most {self.most:.6g}{self.unit}"


def growth(t: np.ndarray, values: np.ndarray) -> float:
    """Return the growth of a series over its second half: the median slope (Theil-Sen) times the duration.

    Parameters
    ----------
    t, values : (N,) times and values. Fewer than four values in the second half give NaN.
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
    """Assess memory: over the second half, it may grow by two arenas."""
    grown = growth(t, bytes_held)
    return Finding(f"{what}: memory, growth in the second half", " MiB", grown / 2**20, 2 * ARENA / 2**20)


def count(what: str, values: np.ndarray) -> Finding:
    """Assess descriptors or threads: the median in the last quarter must not exceed the median in the second."""
    before, after = _quarters(values, np.median)
    return Finding(f"{what}, median of the last quarter", "", after, before)


def delay(what: str, seconds: np.ndarray) -> Finding:
    """Assess delays, one per segment: compare the minimum in the last quarter with the minimum in the second."""
    before, after = _quarters(seconds, np.min)
    return Finding(f"{what}, minimum in the last quarter", " ms", 1e3 * after, 1e3 * (LATER * before + MARGIN))


def equal(what: str, found: float, wanted: float) -> Finding:
    """Assess a quantity that must have an exact value."""
    return Finding(f"{what} ({found:.0f} of {wanted:.0f}), difference", "", abs(found - wanted), 0.0)


def _quarters(values: np.ndarray, reduce: Callable[[np.ndarray], Any]) -> tuple[float, float]:
    """Return one statistic of the second and last quarters; NaN if there are too few points."""
    if len(values) < 4:
        return float("nan"), float("nan")
    quarters = np.array_split(np.asarray(values, dtype=float), 4)
    return float(reduce(quarters[1])), float(reduce(quarters[3]))
