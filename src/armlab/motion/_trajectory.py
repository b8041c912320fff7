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
    """Weights (m, n); ends (M, 3, n); covariances per coordinate (n, m + 3 M, m + 3 M) of weights and ends; noise (n,);
    residuals (N, n); triangle of the unknowns of the first coordinate; numbers of the ends that are free."""

    weights: np.ndarray
    ends: np.ndarray
    cov: np.ndarray
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
    selectors: np.ndarray  # (3, N): what of the samples is pinned
    samples: int


def _rows(primitive: Any, demo: Demo, tau: float, hold: float, ends: Ends) -> _Rows:
    t, N = demo.t, len(demo.t)
    step = demo.duration / (N - 1)
    rest = demo.duration + step * np.arange(1, round(hold * demo.duration / step) + 1)
    Y, _ = primitive.response(np.concatenate([t, rest]), tau, demo.duration / FINE * (1 + 1e-9))
    kernels, columns = Y[:, :-3], Y[:, -3:].copy()
    columns[N:, 2] -= 1.0
    selectors = np.zeros((3, N))
    for k, name in enumerate(ENDS):
        if name in ends.pinned:
            selectors[k, {"y0": 0, "v0": 1, "g": N - 1}[name]] = 1.0 / t[1] if name == "v0" else 1.0
            if name == "v0":
                selectors[k, 0] = -1.0 / t[1]
    roots = np.sqrt(np.concatenate([demo.weights, np.ones(len(rest))]))
    return _Rows(kernels, columns, roots, selectors, N)


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
    weights, all_ends, cov, sigma, residuals = (np.concatenate(a, axis=-1) for a in zip(*(f[:5] for f in found)))
    return Found(weights, all_ends, np.moveaxis(cov, -1, 0), sigma, residuals, found[0][5], free)


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
        fixed[k] = part.selectors @ y
        for e, name in enumerate(ENDS):
            if name in ends.known:
                fixed[k, e] = ends.known[name][block]
        A[rows, :m] = scale[k] * part.kernels
        A[rows, m + k * f : m + (k + 1) * f] = part.ends[:, free]
        b[rows] = -part.ends @ fixed[k]
        b[rows][: part.samples] += y
        A[rows] *= part.roots[:, None]
        b[rows] *= part.roots[:, None]
    penalties = np.concatenate([np.full(m, ridge), np.zeros(M * f)]) if ridge else None
    found = solve(A, b, penalties)
    estimator = found.G @ A.T  # (p, R): from whitened rows to the unknowns
    every, dof, squares, residuals = [], 0.0, 0.0, []
    for k, part in enumerate(parts):
        rows = slice(*heights[k : k + 2])
        whitened = estimator[:, rows]
        sensitivity = whitened[:, : part.samples] * part.roots[: part.samples]
        sensitivity = sensitivity - (whitened * part.roots) @ part.ends @ part.selectors
        own = part.selectors.copy()
        own[list(free)] = sensitivity[m + k * f : m + (k + 1) * f]
        N = part.samples
        model = np.concatenate([scale[k] * part.kernels[:N], part.ends[:N]], axis=1)
        dof += N - np.einsum("ij,ji->", model, np.concatenate([sensitivity[:m], own]))
        r = (b[rows] - A[rows] @ found.x)[:N]
        squares = squares + (r**2).sum(axis=0)
        roots = part.roots[:N]
        residuals.append(-r / np.where(roots > 0, roots, 1.0)[:, None])
        full = np.zeros((m + 3 * M, N))
        full[:m] = sensitivity[:m]
        for j in range(M):
            full[m + 3 * j + np.array(free, dtype=int)] = sensitivity[m + j * f : m + (j + 1) * f]
        full[m + 3 * k : m + 3 * k + 3] = own
        every.append(full / np.where(roots > 0, roots, 1.0))
    sigma = np.sqrt(squares / max(dof, 1.0))
    D = np.concatenate(every, axis=1)
    cov = (D @ D.T)[..., None] * sigma**2
    fixed[:, list(free)] = found.x[m:].reshape(M, f, b.shape[1])
    return found.x[:m], fixed, cov, sigma, np.concatenate(residuals), found.triangle
