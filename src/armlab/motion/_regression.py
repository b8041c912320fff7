"""The weights nearest to the forcing that the acceleration of the demonstrations asks for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from armlab.motion._least_squares import rows as room
from armlab.motion._least_squares import solve_joined

__all__ = ["Forced", "Regression", "fit_regression"]


@dataclass(frozen=True)
class Forced:
    """What one demonstration asks for: phase x (N,), or (N, n) where every coordinate has its own; forcing f (N, n);
    scale (n,) of it; weights of the samples (N,)."""

    x: np.ndarray
    f: np.ndarray
    scale: np.ndarray
    weights: np.ndarray


@dataclass(frozen=True)
class Regression:
    """Weights (m, n), their covariances (n, m, m) for noise of unit variance, noise of the forcing (n,), what makes the
    residuals (N, n), and triangle (m, m) of the first coordinate."""

    weights: np.ndarray
    unit: np.ndarray
    sigma: np.ndarray
    residuals: Callable[[], np.ndarray]
    triangle: np.ndarray


def fit_regression(
    demos: Sequence[Forced],
    primitive: Any,
    m: int,
    fades: bool,
    ridge: float,
    bells: tuple[np.ndarray, np.ndarray] | None,
) -> Regression:
    """Fit weights that demonstrations share to their forcing, by least squares or kernel by kernel.

    Parameters
    ----------
    demos : the demonstrations. primitive : with m kernels. fades : whether the forcing has the factor x.
    ridge : penalty of the weights. bells : centres and widths; when given each weight is a mean of its own, weighed by
        its bell: ``sum bell x f / sum bell x^2`` (None: least squares; widths empty: kernels over their sum).
    """
    n = demos[0].f.shape[1]
    scales = np.array([demo.scale for demo in demos])
    alike = demos[0].x.ndim == 1 and bool((scales == scales[:, :1]).all())
    found, left = [], []
    for block in [slice(0, n)] if alike else [slice(i, i + 1) for i in range(n)]:
        i = block.start
        x = _joined([demo.x if demo.x.ndim == 1 else demo.x[:, i] for demo in demos])
        lever = np.repeat(scales[:, i], [len(demo.f) for demo in demos]) * (x if fades else 1.0)
        rows = _Rows(primitive, m, x, lever, _joined([demo.f[:, block] for demo in demos]))
        weights = _joined([demo.weights for demo in demos])
        one = _least_squares(rows, weights, ridge) if bells is None else _kernel_by_kernel(rows, weights, *bells)
        found.append(one)
        left.append(partial(rows.residuals, one[0]))
    w, squares = (np.concatenate([one[k] for one in found], axis=-1) for k in (0, 3))
    N = sum(len(demo.f) for demo in demos)
    return Regression(
        w,
        np.concatenate([np.broadcast_to(one[1], (one[0].shape[1], m, m)) for one in found]),
        np.sqrt(squares / max(N - m, 1)),
        lambda: np.concatenate([one() for one in left], axis=-1),
        found[0][2],
    )


def _joined(parts: list[np.ndarray]) -> np.ndarray:
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


@dataclass(frozen=True)
class _Rows:
    """Equations ``lever psi(x) w = f`` of coordinates that share x (N,) and lever (N,); psi (N, m), f (N, q)."""

    primitive: Any
    m: int
    x: np.ndarray
    lever: np.ndarray
    f: np.ndarray

    def residuals(self, w: np.ndarray) -> np.ndarray:
        return self.f - (self.primitive.basis(self.x) @ w) * self.lever[:, None]


def _least_squares(rows: _Rows, weights: np.ndarray, ridge: float) -> tuple[np.ndarray, ...]:
    """Return weights, unit covariance, triangle and sums of squares."""
    roots, m, (N, q) = np.sqrt(weights), rows.m, rows.f.shape
    penalty = np.full(m, ridge) if ridge else None
    joined = rows.primitive.design(rows.x, rows.lever * roots, room(N, m, penalty), m + q).T
    one = solve_joined(joined, rows.f * roots[:, None], penalty)
    if not ridge:
        return one.x, one.G, one.triangle, one.squares
    squares = (one.squares - ridge * (one.x**2).sum(axis=0)).clip(min=0.0)
    return one.x, one.G - ridge * one.G @ one.G, one.triangle, squares


def _kernel_by_kernel(
    rows: _Rows, weights: np.ndarray, centres: np.ndarray, widths: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Return weights, unit covariance, triangle and sums of squares."""
    if len(widths):
        bell = np.exp(-0.5 * ((rows.x[:, None] - centres) / widths) ** 2)
    else:
        bell = rows.primitive.basis(rows.x)
    top = bell * (weights * rows.lever)[:, None]
    squares = top.T @ rows.lever
    told = squares > 0
    L = top / np.where(told, squares, 1.0)
    w = L.T @ rows.f
    spread = (L / np.where(weights > 0, weights, 1.0)[:, None]).T @ L
    return w, spread, np.diag(np.sqrt(squares)), weights @ rows.residuals(w) ** 2
