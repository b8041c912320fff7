"""Bounds on the parameters of a least-squares problem that is already solved without them."""

from __future__ import annotations

import numpy as np

from armlab._numbers import numbers
from armlab.errors import ShapeError

__all__ = ["within_bounds"]

BLOCK_ROUNDS = 10  # rounds without fewer faults after which one fault at a time is mended


def within_bounds(x: np.ndarray, cov: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return the nearest point to x in the box, ``min (z - x)^T cov^-1 (z - x)`` over ``lower <= z <= upper``.

    With A the bounds that hold, ``z = x + cov[:, A] m`` and ``m = cov[A, A]^-1 (bound - x)[A]``: the other parameters
    follow their correlations. A is right when every free z is inside and every m pushes inwards; block principal
    pivoting mends all faults at once, and after ten rounds without progress the first one only, which always ends.

    Parameters
    ----------
    x : (p,) solution without bounds. cov : (p, p) its covariance, up to a factor.
    lower, upper : (p,) bounds, lower < upper.

    Returns
    -------
    (p,) solution within the bounds; exactly at those that hold.

    References
    ----------
    Portugal, Judice and Vicente (1994), A comparison of block pivoting and interior-point algorithms.
    """
    x, cov, lower, upper = (
        numbers(one, "solution, covariance and bounds", ShapeError) for one in (x, cov, lower, upper)
    )
    p = x.size
    if not x.shape == lower.shape == upper.shape == (p,) or cov.shape != (p, p):
        raise ShapeError(
            f"Expected x and its bounds (p,) and cov (p, p), got {x.shape}, {lower.shape}, {upper.shape}, {cov.shape}."
        )
    if np.all((x >= lower) & (x <= upper)):
        return x
    sd = np.sqrt(np.diag(cov))
    sd = np.where(sd > 0, sd, 1.0)
    correlation = cov / np.outer(sd, sd)
    low, high, free = lower / sd, upper / sd, x / sd
    side = np.zeros(len(x), dtype=int)  # -1 at the lower bound, +1 at the upper
    fewest, patience = len(x) + 1, BLOCK_ROUNDS
    while True:
        held = np.flatnonzero(side)
        bound = np.where(side[held] < 0, low[held], high[held])
        push = np.linalg.solve(correlation[np.ix_(held, held)], bound - free[held])
        z = free + correlation[:, held] @ push
        z[held] = bound
        faults = np.where(z < low, -1, np.where(z > high, 1, 0))
        outward = held[push * side[held] > 0]
        wrong = np.union1d(np.flatnonzero(faults), outward)
        if not len(wrong):
            return np.where(side < 0, lower, np.where(side > 0, upper, z * sd))
        if len(wrong) < fewest:
            fewest, patience = len(wrong), BLOCK_ROUNDS
        else:
            patience -= 1
        mended = wrong if patience > 0 else wrong[-1:]
        side[mended] = np.where(side[mended] != 0, 0, faults[mended])
