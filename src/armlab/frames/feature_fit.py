"""Shared steps of feature fits: validation of points and noise, outlier detection, sign of a normal, result.

Outliers are found by least median of squares over minimal sets of points (Rousseeuw 1984). The feature is refitted to
the best half of the points, and outliers are flagged relative to the refit. Degenerate sets, such as three collinear
points, yield NaN or infinite distances.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from itertools import combinations
from math import comb
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from armlab.errors import NotExcited, ShapeError
from armlab.estimation import Excitation, Fit
from armlab.estimation.nonlinear import median_norm
from armlab.frames import inputs
from armlab.frames.features import Circle, Line, Plane, Sphere

Feature = TypeVar("Feature", Plane, Line, Circle, Sphere)

LIMIT = 0.2  # rad, largest accepted standard deviation of a tilt
SIDE_DEVIATIONS = 3.0  # minimum distance from the origin, in standard deviations, for determining the side

ALL_SETS, SOME_SETS = comb(60, 3), 500  # largest number of sets for an exhaustive search; size of a random selection
FLAGGED = 0.999  # quantile of chi^2 beyond which a point is an outlier
MAX_ITERATIONS = 3  # maximum number of refits
MAX_SCORING_POINTS = 1000  # maximum number of points used to score the sets
INITIAL_TOLERANCE = 2.0  # correction factor for the noise of the best half, which is biased low
CHUNK = 200_000  # distances held in memory at once

Squares = Callable[[np.ndarray, np.ndarray], np.ndarray]
Refit = Callable[[np.ndarray], tuple[float, np.ndarray]]


class Cloud:
    """Validated points (N, 3) with their noise (None if it must be estimated) and the mask of the inliers."""

    def __init__(self, p: ArrayLike, noise: Any, least: int, what: str) -> None:
        self.p = inputs.points(p)
        self.sigma, self.each = inputs.noises_of(noise, len(self.p))
        self.kept = np.ones(len(self.p), dtype=bool)
        self._needed, self._what = least + (self.sigma is None), what
        inputs.check_count(len(self.p), self._needed, what)

    def choose(self, size: int, numbers: int, through: Squares, refit: Refit) -> None:
        self.kept = inliers(self.p, size, numbers, through, refit, self.sigma, self._what)
        inputs.check_count(int(self.kept.sum()), self._needed, self._what)


def result(
    value: Feature,
    parameters: np.ndarray,
    cov: np.ndarray,
    sigma: np.ndarray,
    residuals: np.ndarray,
    kept: np.ndarray,
    excitation: Excitation,
    summary: Callable[[Fit[Any]], str],
) -> Fit[Feature]:
    """Return the fit of a feature; the points that are not kept are its outliers."""
    return Fit(
        value, value.names, value.units, parameters, cov, sigma, residuals, int(kept.sum()), excitation, summary,
        ~kept, ("distance [m]",),
    )  # fmt: skip


def upward(
    n: np.ndarray, c: np.ndarray, reach: float, toward: ArrayLike | None, normal: ArrayLike | None, what: str
) -> np.ndarray:
    """Return n or -n, whichever points towards the side of the hint or, without a hint, away from the origin; `reach`
    is the SD of the offset [m]."""
    if toward is not None and normal is not None:
        raise ShapeError("Expected toward= or normal=, got both. Omit one of these arguments.")
    if normal is not None:
        side, least = float(n @ inputs.direction(normal, "normal")), 1e-6
    elif toward is not None:
        side, least = float(n @ (inputs.vector(toward, "toward") - c)), SIDE_DEVIATIONS * reach
    else:
        side, least = float(n @ c), SIDE_DEVIATIONS * reach
        if not abs(side) > least:
            raise NotExcited(
                f"Expected the {what} to be far enough from the origin "
                "to determine which of its sides faces the origin, got a distance of "
                f"{abs(side):.2g} m with a standard deviation of {reach:.2g} m. Pass toward= (a point on the desired "
                "side) or normal=.",
                [f"side of the {what}"],
                [f"{abs(side):.2g} m from the origin"],
            )
    if not abs(side) > least:
        raise ShapeError(
            f"Expected a hint that determines the side of the {what}, "
            "got a hint on neither side. Pass a different point or normal."
        )
    return n if side > 0 else -n


def text(v: np.ndarray) -> str:
    """Format a vector (3,) for a report."""
    return "(" + ", ".join(f"{x:.4f}" for x in v) + ")"


def inliers(
    p: np.ndarray, size: int, numbers: int, through: Squares, refit: Refit, sigma: float | None, what: str
) -> np.ndarray:
    """Return the mask (N,) of the inliers, from minimal sets of `size` points with `numbers` residuals per point."""
    from scipy.special import chdtri

    if len(p) < size + 2:
        raise NotExcited(
            f"Expected at least {size + 2} points to detect outliers of a {what}, got {len(p)}. Measure more points.",
            ["outliers"],
            [f"{len(p)} points"],
        )
    jury = np.arange(len(p))
    if len(p) > MAX_SCORING_POINTS:
        jury = np.sort(np.random.default_rng([len(p), size]).choice(len(p), MAX_SCORING_POINTS, replace=False))
    height = (len(jury) + size + 1) // 2
    scale, squares = _best(p[jury], size, height, through)
    limit = float(chdtri(numbers, 1.0 - FLAGGED))
    spread = (1.0 + 5.0 / (len(p) - size)) * np.sqrt(scale) / median_norm(numbers)
    half = np.zeros(len(p), dtype=bool)
    half[jury[np.argsort(squares, kind="stable")[:height]]] = True
    kept = half
    with suppress(NotExcited):  # half of the points may be too few
        kept = refit(half)[1] <= limit * (INITIAL_TOLERANCE * max(sigma or spread, rounding(p))) ** 2
    for _ in range(MAX_ITERATIONS):
        noise, squares = refit(kept)
        fresh = squares <= limit * max(sigma or noise, rounding(p)) ** 2
        if np.array_equal(fresh, kept):
            break
        kept = fresh
    return kept


def _best(p: np.ndarray, size: int, height: int, through: Squares) -> tuple[float, np.ndarray]:
    """Return the scale of the best feature through a minimal set, and the squared distances (N,) from it."""
    scale, squares = np.inf, np.zeros(len(p))
    sets = _sets(len(p), size)
    some = 1 + CHUNK // len(p)
    for a in range(0, len(sets), some):
        found = np.nan_to_num(through(p[sets[a : a + some]], p), nan=np.inf)
        level = np.partition(found, height - 1, axis=1)[:, height - 1]
        best = int(np.argmin(level))
        if level[best] < scale:
            scale, squares = float(level[best]), found[best]
    return scale, squares


def _sets(count: int, size: int) -> np.ndarray:
    """Return all sets (S, size) of indices below `count`, or 500 random sets if there are too many."""
    if comb(count, size) <= ALL_SETS:
        return np.array(list(combinations(range(count), size)))
    rng = np.random.default_rng([count, size])
    return np.stack([rng.choice(count, size, replace=False) for _ in range(SOME_SETS)])


def planes(sets: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Return squared distances (S, N) from the planes through sets (S, 3, 3)."""
    n = np.cross(sets[:, 1] - sets[:, 0], sets[:, 2] - sets[:, 0])
    length = np.linalg.norm(n, axis=1, keepdims=True)
    n = np.divide(n, length, out=np.full_like(n, np.nan), where=length > 0)
    return (n @ p.T - np.sum(n * sets[:, 0], axis=1)[:, None]) ** 2


def lines(sets: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Return squared distances (S, N) from the lines through sets (S, 2, 3)."""
    v = sets[:, 1] - sets[:, 0]
    length = np.linalg.norm(v, axis=1, keepdims=True)
    v = np.divide(v, length, out=np.full_like(v, np.nan), where=length > 0)
    away = p - sets[:, :1]
    return np.sum(np.cross(away, v[:, None]) ** 2, axis=2)


def circles(sets: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Return squared distances (S, N) from the circles through sets (S, 3, 3)."""
    a, b = sets[:, 1] - sets[:, 0], sets[:, 2] - sets[:, 0]
    n = np.cross(a, b)
    twice = np.sum(n**2, axis=1, keepdims=True)
    aa, bb = np.sum(a**2, axis=1, keepdims=True), np.sum(b**2, axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        to_centre = (np.cross(n, a) * bb + np.cross(b, n) * aa) / (2.0 * twice)
        unit = n / np.sqrt(twice)
        away = p - (sets[:, 0] + to_centre)[:, None]
        z = np.einsum("snk,sk->sn", away, unit)
        rho = np.sqrt(np.maximum(np.sum(away**2, axis=2) - z**2, 0.0))
        return (rho - np.linalg.norm(to_centre, axis=1)[:, None]) ** 2 + z**2


def spheres(sets: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Return squared distances (S, N) from the spheres through point sets (S, 4, 3)."""
    edges = sets[:, 1:] - sets[:, :1]
    volume = np.abs(np.linalg.det(edges)) > 1e-12 * np.linalg.norm(edges, axis=2).prod(axis=1)
    squares = np.full((len(sets), len(p)), np.nan)
    to_centre = np.linalg.solve(edges[volume], 0.5 * np.sum(edges[volume] ** 2, axis=2)[..., None])[..., 0]
    away = p - (sets[volume, 0] + to_centre)[:, None]
    squares[volume] = (np.linalg.norm(away, axis=2) - np.linalg.norm(to_centre, axis=1)[:, None]) ** 2
    return squares


def rounding(p: np.ndarray) -> float:
    """Return the rounding error of points (N, 3), which is the lower limit of every standard deviation."""
    return 1e-14 * max(float(np.abs(p).max(initial=0.0)), 1e-300)


def principal(p: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the centroid, the principal directions (3, 3) as rows, strongest first, and the sums of squares (3,)."""
    c = p.mean(axis=0)
    R = np.linalg.qr(p - c, mode="r")  # QR first: R has the principal directions of all points
    _, singular, axes = np.linalg.svd(np.vstack([R, np.zeros((3 - len(R), 3))]))
    return c, axes * np.where(axes[np.arange(3), np.abs(axes).argmax(axis=1)] < 0, -1.0, 1.0)[:, None], singular**2
