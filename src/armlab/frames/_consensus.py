"""Which points belong to a feature: the best of many features through as few points as make one.

Each minimal set of points makes a feature; its scale is the h-th smallest distance of all points from it,
``h = (N + size + 1) / 2``, so that nearly half of the points may be anywhere (Rousseeuw 1984, least median of squares).
The h points nearest to the feature of smallest scale are refitted; flags then follow the refit.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from itertools import combinations
from math import comb

import numpy as np

from armlab.errors import NotExcited
from armlab.estimation.nonlinear import median_norm
from armlab.frames._cloud import rounding

__all__ = ["chosen"]

ALL_SETS = comb(60, 3)  # up to here every set is tried
SOME_SETS = 500
FLAGGED = 0.999  # quantile of chi^2 beyond which a point is an outlier
ROUNDS = 3
JURY = 1000  # points that judge the sets, where there are more
ROOM = 2.0  # for points at first: the half that was refitted leans towards its own noise
AT_ONCE = 200_000  # distances that are held at once

Squares = Callable[[np.ndarray, np.ndarray], np.ndarray]
Refit = Callable[[np.ndarray], tuple[float, np.ndarray]]


def chosen(
    p: np.ndarray, size: int, numbers: int, through: Squares, refit: Refit, sigma: float | None, what: str
) -> np.ndarray:
    """Return which points (N,) belong to the feature.

    Parameters
    ----------
    p : (N, 3) points. size : of a minimal set. numbers : of residual per point.
    through : (sets (S, size, 3), p) -> squared distances (S, N) of p from the features through the sets.
    refit : which points (N,) -> noise found, and squared distances (N,) of all points.
    sigma : noise of a coordinate when it is known. what : name of the feature.
    """
    from scipy.special import chdtri

    if len(p) < size + 2:
        raise NotExcited(
            f"Expected at least {size + 2} points to find outliers of a {what}, got {len(p)}. Measure more points.",
            ["outliers"],
            [f"{len(p)} points"],
        )
    jury = np.arange(len(p))
    if len(p) > JURY:
        jury = np.sort(np.random.default_rng([len(p), size]).choice(len(p), JURY, replace=False))
    height = (len(jury) + size + 1) // 2
    scale, squares = _best(p[jury], size, height, through)
    limit = float(chdtri(numbers, 1.0 - FLAGGED))
    spread = (1.0 + 5.0 / (len(p) - size)) * np.sqrt(scale) / median_norm(numbers)
    half = np.zeros(len(p), dtype=bool)
    half[jury[np.argsort(squares, kind="stable")[:height]]] = True
    kept = half
    with suppress(NotExcited):  # half of the points may tell too little
        kept = refit(half)[1] <= limit * (ROOM * max(sigma or spread, rounding(p))) ** 2
    for _ in range(ROUNDS):
        noise, squares = refit(kept)
        fresh = squares <= limit * max(sigma or noise, rounding(p)) ** 2
        if np.array_equal(fresh, kept):
            break
        kept = fresh
    return kept


def _best(p: np.ndarray, size: int, height: int, through: Squares) -> tuple[float, np.ndarray]:
    """Return the scale of the best feature through a minimal set, and squared distances (N,) from it."""
    scale, squares = np.inf, np.zeros(len(p))
    sets = _sets(len(p), size)
    some = 1 + AT_ONCE // len(p)
    for a in range(0, len(sets), some):
        found = np.nan_to_num(through(p[sets[a : a + some]], p), nan=np.inf)
        level = np.partition(found, height - 1, axis=1)[:, height - 1]
        best = int(np.argmin(level))
        if level[best] < scale:
            scale, squares = float(level[best]), found[best]
    return scale, squares


def _sets(count: int, size: int) -> np.ndarray:
    """Return all sets (S, size) of numbers below count, or 500 seeded ones where there are too many."""
    if comb(count, size) <= ALL_SETS:
        return np.array(list(combinations(range(count), size)))
    rng = np.random.default_rng([count, size])
    return np.stack([rng.choice(count, size, replace=False) for _ in range(SOME_SETS)])
