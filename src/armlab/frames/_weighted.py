"""Planes and lines through points whose noise differs between directions or points.

With e the distances of a point from the feature, D their directions (k, 3) and C the covariance of the point, the cost
is the sum of ``e^T S^-1 e``, ``S = D C D^T``. S depends on the feature; the gradient of the cost is nevertheless that
of plain residuals when the lever of a tilt is taken at the most likely place ``p - C D^T S^-1 e``, not at p.
"""

from __future__ import annotations

import numpy as np

from armlab.estimation import Measurement, NonlinearProblem, NonlinearSolution, nonlinear_least_squares
from armlab.frames import _check
from armlab.frames.features import Line, Plane
from armlab.lie import so3

__all__ = ["line", "plane"]


def plane(p: np.ndarray, cov: np.ndarray, start: Plane, robust: bool) -> NonlinearSolution[Plane]:
    """Return the most likely plane of points (N, 3) with covariances (N, 3, 3), near a start."""

    def evaluate(value: Plane) -> list[Measurement]:
        e, root, away = _likely(p - value.centroid, value.n[None], cov)
        lift = away @ np.cross(value.axes, value.n).T
        J = np.concatenate([lift, np.full((len(p), 1), -1.0)], axis=1)[:, None]
        return [_whitened(e, J, root)]

    def step(value: Plane, x: np.ndarray) -> Plane:
        n, axes = _check.turned(so3.exp(x[:2] @ value.axes), value.n, value.axes)
        c = value.centroid + x[2] * value.n
        return Plane(n, float(n @ c), c, axes)

    return nonlinear_least_squares(NonlinearProblem(evaluate, step, what="plane"), start, robust=robust)


def line(p: np.ndarray, cov: np.ndarray, start: Line, robust: bool) -> NonlinearSolution[Line]:
    """Return the most likely line of points (N, 3) with covariances (N, 3, 3), near a start."""

    def evaluate(value: Line) -> list[Measurement]:
        e, root, away = _likely(p - value.centroid, value.axes, cov)
        lever = away @ value.v
        J = np.zeros((len(p), 2, 4))
        J[:, 1, 0], J[:, 0, 1] = lever, -lever
        J[:, 0, 2] = J[:, 1, 3] = -1.0
        return [_whitened(e, J, root)]

    def step(value: Line, x: np.ndarray) -> Line:
        v, axes = _check.turned(so3.exp(x[:2] @ value.axes), value.v, value.axes)
        c = value.centroid + x[2:] @ value.axes
        return Line(v, c - v * (v @ c), c, axes)

    return nonlinear_least_squares(NonlinearProblem(evaluate, step, what="line"), start, robust=robust)


def _likely(away: np.ndarray, D: np.ndarray, cov: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return distances (N, k), the root of their covariance (N, k, k), and where the points (N, 3) most likely are."""
    e, CD = away @ D.T, cov @ D.T
    S = D @ CD
    return e, np.linalg.cholesky(S), away - (CD @ np.linalg.solve(S, e[..., None]))[..., 0]


def _whitened(e: np.ndarray, J: np.ndarray, root: np.ndarray) -> Measurement:
    """Return distances (N, k) in deviations: the descent then judges its steps by the whole cost."""
    k = e.shape[1]
    return Measurement(
        np.linalg.solve(root, e[..., None])[..., 0], np.linalg.solve(root, J), np.eye(k), ("distance",) * k
    )
