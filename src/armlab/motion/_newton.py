"""Weights of a primitive whose phase is its own position: Gauss and Newton on the trajectory, from a first guess."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

__all__ = ["descend"]

ROUNDS = 20
ENOUGH = 1e-6  # relative gain of the error below which to stop
STEP = 1e-6  # of the largest weight, for the slopes
DAMPING = 1e-8  # of the mean square of a column


def descend(
    run: Callable[[np.ndarray], np.ndarray], y: np.ndarray, roots: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return weights (m, n), the inverses of the normal matrices (n, m, m), and residuals (N, n).

    The coordinates do not see each other, so that one weight of each is moved at once.

    Parameters
    ----------
    run : weights (K, m, n) -> motions (N, K, n). y : (N, n) to follow. roots : (N,) of the weights of the samples.
    weights : (m, n) where to begin.
    """
    m, n = weights.shape
    w, damping = weights, np.full(n, DAMPING)
    error, inverses = np.inf, np.empty((n, m, m))
    for _ in range(ROUNDS):
        h = STEP * np.maximum(abs(w).max(axis=0), 1.0)
        moved = np.concatenate([w[None], w + h * np.eye(m)[:, :, None]])
        paths = run(moved)
        r = roots[:, None] * (y - paths[:, 0])
        J = roots[:, None, None] * (paths[:, 1:] - paths[:, :1]) / h
        steps = np.empty_like(w)
        for i in range(n):
            normal = J[:, :, i].T @ J[:, :, i]
            normal[np.diag_indices(m)] += damping[i] * np.trace(normal) / m + np.finfo(float).tiny
            inverses[i] = np.linalg.inv(normal)
            steps[:, i] = inverses[i] @ (J[:, :, i].T @ r[:, i])
        now = (r**2).sum(axis=0)
        tried = run(np.array([w + part * steps for part in (1.0, 0.5, 0.1)]))
        errors = ((roots[:, None, None] * (y[:, None] - tried)) ** 2).sum(axis=0)
        best = errors.argmin(axis=0)
        gained = np.take_along_axis(errors, best[None], axis=0)[0] < now
        w = w + np.where(gained, np.array([1.0, 0.5, 0.1])[best], 0.0) * steps
        damping = np.where(gained, DAMPING, damping * 100.0)
        total = float(np.minimum(now, errors.min(axis=0)).sum())
        if error - total < ENOUGH * total:
            break
        error = total
    return w, inverses, y - run(w[None])[:, 0]
