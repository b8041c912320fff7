"""The weights whose own motion is nearest to the demonstration: linear, no derivative of what was measured is needed.

The solution of the primitive is linear in weights, start, velocity and goal: ``y = Y [w; y0; v0; g]`` with the response
Y of each alone. What is pinned is a linear function of the samples too, so that its noise is in the covariance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from armlab.motion._demos import Demo
from armlab.motion._least_squares import solve

__all__ = ["ENDS", "Ends", "Found", "fit_trajectory"]

ENDS = ("y0", "v0", "g")
FINE = 1000  # steps of the response over a duration, at least


@dataclass(frozen=True)
class Ends:
    """Start, velocity and goal: `pinned` to the samples by name, or `known` by name (n,); otherwise free."""

    pinned: tuple[str, ...]
    known: dict[str, np.ndarray]


@dataclass(frozen=True)
class Found:
    """Weights (m, n); ends (M, 3, n); covariances (n, m + 3 M, m + 3 M) of weights and ends for noise of unit variance;
    noise (n,); residuals (N, n); triangle of the unknowns of the first coordinate; numbers of the ends that are free.
    """

    weights: np.ndarray
    ends: np.ndarray
    unit: np.ndarray
    sigma: np.ndarray
    residuals: np.ndarray
    triangle: np.ndarray
    free: tuple[int, ...]


@dataclass(frozen=True)
class _Rows:
    """Rows of one demonstration: samples, then rest at the goal. kernels (R, m), ends (R, 3), root weights (R,)."""

    kernels: np.ndarray
    ends: np.ndarray
    roots: np.ndarray
    pins: np.ndarray  # (3 ends, 3 samples: first, second, last) what is pinned to them
    samples: int


def _rows(primitive: Any, demo: Demo, tau: float, hold: float, ends: Ends) -> _Rows:
    t, N = demo.t, len(demo.t)
    step = demo.duration / (N - 1)
    rest = demo.duration + step * np.arange(1, round(hold * demo.duration / step) + 1)
    Y, _ = primitive.response(np.concatenate([t, rest]), tau, demo.duration / FINE * (1 + 1e-9))
    kernels, columns = Y[:, :-3], Y[:, -3:].copy()
    columns[N:, 2] -= 1.0
    pins = np.array([[1.0, 0.0, 0.0], [-1.0 / t[1], 1.0 / t[1], 0.0], [0.0, 0.0, 1.0]])
    pins[[name not in ends.pinned for name in ENDS]] = 0.0
    roots = np.sqrt(np.concatenate([demo.weights, np.ones(len(rest))]))
    return _Rows(kernels, columns, roots, pins, N)


def fit_trajectory(
    primitive: Any,
    demos: Sequence[Demo],
    taus: Sequence[float],
    scales: np.ndarray,
    ends: Ends,
    hold: float,
    ridge: float,
) -> Found:
    """Fit weights that M demonstrations share, and the ends of each.

    Parameters
    ----------
    primitive : kernel with the centres and widths. demos : M of them. taus : of each [s].
    scales : (M, n) of the forcing.
    ends : what is known of the ends. hold : seconds of rest at the goal after the end, over the duration.
    ridge : penalty of the weights.
    """
    parts = [_rows(primitive, demo, tau, hold, ends) for demo, tau in zip(demos, taus)]
    free = tuple(k for k, name in enumerate(ENDS) if name not in ends.pinned and name not in ends.known)
    same = bool((scales == scales[:, :1]).all())
    n = scales.shape[1]
    blocks = [slice(0, n)] if same else [slice(i, i + 1) for i in range(n)]
    found = [_solve(parts, demos, scales[:, block][:, 0], block, ends, free, ridge) for block in blocks]
    weights, all_ends, sigma, residuals = (np.concatenate([one[k] for one in found], axis=-1) for k in (0, 1, 3, 4))
    return Found(weights, all_ends, np.concatenate([one[2] for one in found]), sigma, residuals, found[0][5], free)


def _solve(
    parts: list[_Rows],
    demos: Sequence[Demo],
    scale: np.ndarray,
    block: slice,
    ends: Ends,
    free: tuple[int, ...],
    ridge: float,
) -> tuple[Any, ...]:
    """Solve for coordinates that share one matrix."""
    m, M, f = parts[0].kernels.shape[1], len(parts), len(free)
    heights = np.cumsum([0, *(len(p.kernels) for p in parts)])
    A = np.zeros((heights[-1], m + M * f))
    b = np.zeros((heights[-1], block.stop - block.start))
    fixed = np.zeros((M, 3, b.shape[1]))
    for k, (part, demo) in enumerate(zip(parts, demos)):
        rows, y = slice(*heights[k : k + 2]), demo.y[:, block]
        fixed[k] = part.pins @ y[[0, 1, -1]]
        for e, name in enumerate(ENDS):
            if name in ends.known:
                fixed[k, e] = ends.known[name][block]
        A[rows, :m] = scale[k] * part.kernels
        A[rows, m + k * f : m + (k + 1) * f] = part.ends[:, free]
        b[rows] = -part.ends @ fixed[k]
        b[rows][: part.samples] += y
        A[rows] *= part.roots[:, None]
        b[rows] *= part.roots[:, None]
    found = solve(A, b, np.concatenate([np.full(m, ridge), np.zeros(M * f)]) if ridge else None)
    r = b - A @ found.x
    places = np.concatenate([np.arange(m), *(m + 3 * k + np.array(free, dtype=int) for k in range(M))]).astype(int)
    unit, dof = _spread(A, found.G, parts, heights, places)
    squares, residuals = np.zeros(b.shape[1]), []
    for k, part in enumerate(parts):
        left, roots = r[heights[k] : heights[k] + part.samples], part.roots[: part.samples, None]
        squares += (left**2).sum(axis=0)
        residuals.append(-left / np.where(roots > 0, roots, 1.0))
    sigma = np.sqrt(squares / max(dof, 1.0))
    fixed[:, list(free)] = found.x[m:].reshape(M, f, b.shape[1])
    each = np.broadcast_to(unit, (len(sigma), *unit.shape))
    return found.x[:m], fixed, each, sigma, np.concatenate(residuals), found.triangle


def _spread(
    A: np.ndarray, G: np.ndarray, parts: list[_Rows], heights: np.ndarray, places: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return the covariance of weights and ends for samples of unit variance, and the degrees of freedom of residuals.

    The unknowns are ``x = G A^T y`` of the samples but for those three that ends are pinned to, which shift every row.
    """
    size = parts[0].kernels.shape[1] + 3 * len(parts)
    cov, spread, dof = np.zeros((size, size)), np.zeros_like(G), 0.0
    for k, part in enumerate(parts):
        N, rows = part.samples, A[heights[k] : heights[k + 1]]
        own, at = rows[:N], np.array([0, 1, N - 1])
        roots = np.where(part.roots[at] > 0, part.roots[at], 1.0)
        pins = part.pins / roots
        before = G @ own[at].T
        after = before - G @ (rows.T @ (part.roots[:, None] * part.ends)) @ pins
        others = own[2:-1] @ G
        spread += others.T @ others + after @ after.T
        block = np.arange(size - 3 * (len(parts) - k), size - 3 * (len(parts) - k) + 3)
        cov[np.ix_(places, block)] += after @ pins.T
        cov[np.ix_(block, places)] += pins @ after.T
        cov[np.ix_(block, block)] += pins @ pins.T
        followed = np.trace(own[at] @ (after - before)) + np.trace(roots[:, None] * (part.ends[at] @ pins))
        dof += N - np.einsum("ij,ij->", others, own[2:-1]) - np.einsum("ij,ji->", own[at], before) - followed
    cov[np.ix_(places, places)] += spread
    return cov, float(dof)
