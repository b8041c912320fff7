"""The weights nearest to the forcing that the acceleration of the demonstrations asks for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from armlab.motion._least_squares import solve

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
    """Weights (m, n), their covariances (n, m, m) for noise of unit variance, noise of the forcing (n,), residuals
    (N, n), and triangle (m, m) of the first coordinate."""

    weights: np.ndarray
    unit: np.ndarray
    sigma: np.ndarray
    residuals: np.ndarray
    triangle: np.ndarray


def fit_regression(
    demos: Sequence[Forced], primitive: Any, fades: bool, ridge: float, bells: tuple[np.ndarray, np.ndarray] | None
) -> Regression:
    """Fit weights that demonstrations share to their forcing, by least squares or kernel by kernel.

    Parameters
    ----------
    demos : the demonstrations. primitive : with the kernels. fades : whether the forcing has the factor x.
    ridge : penalty of the weights. bells : centres and widths; when given each weight is a mean of its own, weighed by
        its bell: ``sum bell x f / sum bell x^2`` (None: least squares; widths empty: kernels over their sum).
    """
    n = demos[0].f.shape[1]
    scales = np.array([demo.scale for demo in demos])
    alike = demos[0].x.ndim == 1 and bool((scales == scales[:, :1]).all())
    found = []
    for block in [slice(0, n)] if alike else [slice(i, i + 1) for i in range(n)]:
        i = block.start
        x = np.concatenate([demo.x if demo.x.ndim == 1 else demo.x[:, i] for demo in demos])
        lever = np.concatenate([np.full(len(demo.f), demo.scale[i]) for demo in demos]) * (x if fades else 1.0)
        f = np.concatenate([demo.f[:, block] for demo in demos])
        weights = np.concatenate([demo.weights for demo in demos])
        psi = primitive.basis(x)
        if bells is None:
            w, spread, triangle = _least_squares(psi, lever, f, weights, ridge)
        else:
            bell = psi if not len(bells[1]) else np.exp(-0.5 * ((x[:, None] - bells[0]) / bells[1]) ** 2)
            w, spread, triangle = _kernel_by_kernel(bell, lever, f, weights)
        residuals = f - (psi @ w) * lever[:, None]
        dof = max(len(f) - psi.shape[1], 1)
        sigma = np.sqrt(weights @ residuals**2 / dof)
        found.append((w, np.broadcast_to(spread, (len(sigma), *spread.shape)), sigma, residuals, triangle))
    w, sigma, residuals = (np.concatenate([one[k] for one in found], axis=-1) for k in (0, 2, 3))
    unit = found[0][1] if alike else np.concatenate([one[1] for one in found])
    return Regression(w, unit, sigma, residuals, found[0][4])


def _least_squares(
    psi: np.ndarray, lever: np.ndarray, f: np.ndarray, weights: np.ndarray, ridge: float
) -> tuple[Any, ...]:
    roots = np.sqrt(weights)
    one = solve(psi, f * roots[:, None], np.full(psi.shape[1], ridge) if ridge else None, lever * roots)
    return one.x, one.G - ridge * one.G @ one.G if ridge else one.G, one.triangle


def _kernel_by_kernel(bell: np.ndarray, lever: np.ndarray, f: np.ndarray, weights: np.ndarray) -> tuple[Any, ...]:
    top = bell * (weights * lever)[:, None]
    squares = top.T @ lever
    told = squares > 0
    L = top / np.where(told, squares, 1.0)
    spread = (L / np.where(weights > 0, weights, 1.0)[:, None]).T @ L
    return L.T @ f, spread, np.diag(np.sqrt(squares))
