"""Wrench of one instant from joint torque errors.

``error = A^T x + d + e`` with e ~ N(0, diag(variance)), x ~ N(0, diag(prior)) and bounded errors |d_i| <= bound_i. x is
the wrench, A then the Jacobian, or a force at a known point.

map      S = A^T C A + V, K = C A S^-1, x = K error; no bound.
ls       (A V^-1 A^T)^-1 A V^-1 error; no prior, no bound.
ols      (A A^T)^-1 A error; no weight, no prior, no bound.
lund     (A V A^T + C^-1)^-1 A V error: TFRT-7651 as printed, V a covariance where a weight belongs.
bounded  argmin over x and d by semismooth Newton; eliminating d leaves sum max(|r| - bound, 0)^2 / V + x^T C^-1 x.
clip     the same minimum by d <- clip(error - A^T x), x <- map(error - d).
interval bounded, with the guaranteed interval of `wrench_interval` besides.

A linear estimate x = K error has P = (I - K A^T) C (I - K A^T)^T + K V K^T. With a bound, joints inside their band
carry no information: P = (A diag(active / V) A^T + C^-1)^-1.
"""

from __future__ import annotations

import numpy as np

METHODS = ("map", "bounded", "clip", "interval", "ls", "lund", "ols")  # in the order of the compiled kernel
NEWTON_LIMIT = 60
CLIP_LIMIT = 20_000
KKT_GOAL = 1e-10
WEAKEST = 1e-12  # smallest eigenvalue of the scaled information by which ls still determines x
ROUNDING = 1e-14  # a pivot below it, relative to the largest variance, has no correct digit


def solve_wrench(
    A: np.ndarray, error: np.ndarray, variance: np.ndarray, bound: np.ndarray, prior: np.ndarray, method: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int, float, bool]:
    A = np.asarray(A, dtype=float)
    k, n = A.shape
    error, variance, bound = (np.asarray(a, dtype=float) for a in (error, variance, bound))
    prior = np.asarray(prior, dtype=float)
    every = np.ones(n, dtype=bool)
    try:
        return _solve(A, error, variance, bound, prior, METHODS[method], every)
    except np.linalg.LinAlgError:  # NaN, or so ill-conditioned that no digit is correct
        return np.full(k, np.nan), np.full((k, k), np.nan), every, 0, 0.0, True


def _solve(
    A: np.ndarray, error: np.ndarray, variance: np.ndarray, bound: np.ndarray, prior: np.ndarray, method: str,
    every: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int, float, bool]:  # fmt: skip
    match method:
        case "map":
            return *_joseph(A, _map_gain(A, variance, prior), error, variance, prior), every, 0, 0.0, False
        case "lund":
            weighted = A * variance
            K = _solve_positive(weighted @ A.T + np.diag(1.0 / prior), weighted)
            return *_joseph(A, K, error, variance, prior), every, 0, 0.0, False
        case "ls":
            x, P, singular = _least_squares(A, error, variance)
            return x, P, every, 0, 0.0, singular
        case "ols":
            x, H, singular = _least_squares(A, error, np.ones(len(error)))
            return x, H @ (A * variance) @ A.T @ H, every, 0, 0.0, singular
        case "clip":
            return *_clip(A, error, variance, bound, prior), False
        case _:
            return *_newton(A, error, variance, bound, prior), False


def _joseph(
    A: np.ndarray, K: np.ndarray, error: np.ndarray, variance: np.ndarray, prior: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    B = np.eye(len(prior)) - K @ A.T
    P = (B * prior) @ B.T + (K * variance) @ K.T
    return K @ error, 0.5 * (P + P.T)


def _map_gain(A: np.ndarray, variance: np.ndarray, prior: np.ndarray) -> np.ndarray:
    weighted = prior[:, None] * A
    return _solve_positive(A.T @ weighted + np.diag(variance), weighted.T, ROUNDING).T


def _solve_positive(S: np.ndarray, rows: np.ndarray, least: float = 0.0) -> np.ndarray:
    """Return S^-1 rows; raises LinAlgError when a pivot is not above `least`, relative to the largest entry."""
    if not np.all(np.diag(np.linalg.cholesky(S)) ** 2 > least * np.max(np.diag(S))):
        raise np.linalg.LinAlgError
    return np.linalg.solve(S, rows)


def _least_squares(A: np.ndarray, error: np.ndarray, variance: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool]:
    H = (A / variance) @ A.T
    size = np.sqrt(np.diag(H))
    k = len(H)
    if not np.all(size > 0) or np.linalg.eigvalsh(H / np.outer(size, size))[0] < WEAKEST:
        return np.full(k, np.nan), np.full((k, k), np.nan), True
    P = np.linalg.inv(H / np.outer(size, size)) / np.outer(size, size)
    return P @ (A / variance) @ error, 0.5 * (P + P.T), False


def _beyond(
    y: np.ndarray, A: np.ndarray, error: np.ndarray, variance: np.ndarray, bound: np.ndarray, scale: np.ndarray
) -> tuple[float, np.ndarray, np.ndarray]:
    """Return cost, half its gradient, and residuals less the bound, at unknowns y in units of the prior."""
    r = error - (A * scale[:, None]).T @ y
    beyond = np.copysign(np.maximum(np.abs(r) - bound, 0.0), r)
    gradient = y - (A * scale[:, None]) @ (beyond / variance)
    return float(beyond @ (beyond / variance) + y @ y), gradient, beyond


def _hessian(beyond: np.ndarray, A: np.ndarray, variance: np.ndarray, scale: np.ndarray) -> np.ndarray:
    scaled = A * scale[:, None]
    return np.eye(len(scale)) + (scaled * (beyond != 0) / variance) @ scaled.T


def _finish(
    y: np.ndarray, iterations: int, A: np.ndarray, error: np.ndarray, variance: np.ndarray, bound: np.ndarray,
    prior: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int, float]:  # fmt: skip
    scale = np.sqrt(prior)
    _, gradient, beyond = _beyond(y, A, error, variance, bound, scale)
    if not np.isfinite(gradient).all():
        raise np.linalg.LinAlgError
    P = np.linalg.inv(_hessian(beyond, A, variance, scale)) * np.outer(scale, scale)
    return scale * y, 0.5 * (P + P.T), beyond != 0, iterations, float(np.max(np.abs(gradient)))


def _newton(
    A: np.ndarray, error: np.ndarray, variance: np.ndarray, bound: np.ndarray, prior: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int, float]:
    scale = np.sqrt(prior)
    y = np.zeros(len(prior))
    value, gradient, beyond = _beyond(y, A, error, variance, bound, scale)
    iterations = 0
    while iterations < NEWTON_LIMIT and np.any(gradient):
        step = np.linalg.solve(_hessian(beyond, A, variance, scale), gradient)
        length, trial, after = 1.0, y, (value, gradient, beyond)
        for _ in range(40):
            trial = y - length * step
            after = _beyond(trial, A, error, variance, bound, scale)
            if after[0] <= value - 1e-4 * length * 2.0 * float(gradient @ step):
                break
            length *= 0.5
        if not after[0] < value:  # nothing more to gain in double precision
            break
        y, (value, gradient, beyond) = trial, after
        if length * np.max(np.abs(step)) < 1e-13:
            break
        iterations += 1
    return _finish(y, iterations, A, error, variance, bound, prior)


def _clip(
    A: np.ndarray, error: np.ndarray, variance: np.ndarray, bound: np.ndarray, prior: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int, float]:
    scale = np.sqrt(prior)
    K = _map_gain(A, variance, prior)
    y = np.zeros(len(prior))
    iterations = 0
    while iterations < CLIP_LIMIT:
        _, gradient, beyond = _beyond(y, A, error, variance, bound, scale)
        if np.max(np.abs(gradient)) < KKT_GOAL:
            break
        y = K @ ((A * scale[:, None]).T @ y + beyond) / scale
        iterations += 1
    return _finish(y, iterations, A, error, variance, bound, prior)


def wrench_interval(
    A: np.ndarray, error: np.ndarray, spread: np.ndarray, box: np.ndarray
) -> tuple[np.ndarray | None, np.ndarray]:
    from scipy.optimize import linprog

    A = np.asarray(A, dtype=float)
    k, n = A.shape
    error, spread = np.asarray(error, dtype=float), np.asarray(spread, dtype=float)
    box = np.asarray(box, dtype=float)
    if not np.isfinite(A).all() or not np.isfinite(error).all():
        return np.full((k, 2), np.nan), np.zeros(n, dtype=bool)
    rows = (A * box[:, None]).T
    size = np.maximum(np.max(np.abs(rows), axis=1), 1e-300)
    rows = rows / size[:, None]
    limits = np.concatenate([(error + spread) / size, -(error - spread) / size])
    ends = np.empty((k, 2))
    for a in range(k):
        for end, sign in ((0, 1.0), (1, -1.0)):
            cost = np.zeros(k)
            cost[a] = sign
            found = linprog(cost, np.vstack([rows, -rows]), limits, bounds=[(-1.0, 1.0)] * k, method="highs")
            if found.status == 2:
                return None, _contradicting(rows, limits)
            ends[a, end] = box[a] * (sign * found.fun if found.status == 0 else -sign)
    return ends, np.zeros(n, dtype=bool)


def _contradicting(rows: np.ndarray, limits: np.ndarray) -> np.ndarray:
    """Return joints (n,) whose bands must give way when the total violation is smallest."""
    from scipy.optimize import linprog

    n, k = rows.shape
    cost = np.concatenate([np.zeros(k), np.ones(n)])
    slack = np.vstack([np.hstack([rows, -np.eye(n)]), np.hstack([-rows, -np.eye(n)])])
    found = linprog(cost, slack, limits, bounds=[(-1.0, 1.0)] * k + [(0.0, None)] * n, method="highs")
    return found.x[k:] > 1e-9
