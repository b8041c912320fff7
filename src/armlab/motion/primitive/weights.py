"""Fit of the weights of a movement primitive to the trajectory or the forcing of demonstrations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from armlab.motion.dmp import Dmp
from armlab.motion.primitive.demonstrations import Demo
from armlab.motion.primitive.run import progress

ENDS = ("y0", "v0", "g")
FINE = 1000  # minimum number of integration steps of the response over a duration

MAX_ITERATIONS = 20
TOLERANCE = 1e-6  # relative decrease of the error below which the iteration stops
STEP = 1e-6  # step for numerical derivatives, as a fraction of the largest weight
DAMPING = 1e-8  # damping, relative to the mean square of a column


@dataclass(frozen=True)
class Learned:
    """Fitted weights, end values (start, velocity, goal) and statistics."""

    weights: np.ndarray  # (m, n)
    ends: np.ndarray  # (M, 3, n) y0, v0, g of each demonstration
    unit: np.ndarray  # (n, d, d) covariance of the weights, and of fitted end values, for unit noise variance
    sigma: np.ndarray  # (n,) standard deviation of the noise
    residuals: np.ndarray  # (N, n) of position or forcing
    triangle: np.ndarray  # triangular factor of the equations for the unknowns
    unknowns: tuple[int, ...]  # indices among weights and end values
    of_position: bool
    scales: np.ndarray  # (M, n)

    def path(self, dmp: Dmp, demo: Demo, k: int) -> np.ndarray:
        """Return the motion (N, n) of demonstration k."""
        y0, v0, g = self.ends[k]
        tau = dmp.tau_d * demo.duration / dmp.duration
        return dmp._primitive.rollout(demo.t, tau, y0, v0, g, np.ascontiguousarray(self.scales[k]))[0]


@dataclass(frozen=True)
class WeightProblem:
    """Fitting problem: empty primitive, options of `fit_dmp`, and demonstrations with scales, starts, goals (M, n).

    Start, velocity and goal, selected by name, are `pinned` to the samples, `known` (n,), or free.
    """

    method: str
    blank: Dmp
    demos: list[Demo]
    scales: np.ndarray
    starts: np.ndarray
    goals: np.ndarray
    pinned: tuple[str, ...]
    known: dict[str, np.ndarray]
    hold: float
    ridge: float
    bandwidth: float | None
    raw: bool

    def of_each(self) -> list[WeightProblem]:
        """Return a separate problem for each demonstration."""
        parts = zip(self.demos, self.scales, self.starts, self.goals)
        return [replace(self, demos=[d], scales=s[None], starts=a[None], goals=b[None]) for d, s, a, b in parts]

    def tau(self, demo: Demo) -> float:
        """Return the time constant of a demonstration [s]."""
        return self.blank.tau_d * demo.duration / self.blank.duration

    def blocks(self, alike: bool) -> list[slice]:
        """Return groups of coordinates that share a matrix: a single group if all are scaled equally."""
        n = self.blank.n
        same = alike and bool((self.scales == self.scales[:, :1]).all())
        return [slice(0, n)] if same else [slice(i, i + 1) for i in range(n)]


def learn(problem: WeightProblem) -> Learned:
    """Fit weights shared by M demonstrations."""
    by_motion = problem.method == "trajectory"
    if by_motion and problem.blank.schedule != "position":
        return fit_trajectory(problem)
    phases, forcings, speeds = zip(*(_forced(problem, k) for k in range(len(problem.demos))))
    ends = np.stack([problem.starts, np.array(speeds), problem.goals], axis=1)
    first = fit_regression(problem, np.concatenate(phases), np.concatenate(forcings), ends)
    return _refined(problem, first) if by_motion else first


def _refined(problem: WeightProblem, learned: Learned) -> Learned:
    """Refine the weights for schedule "position" by Gauss-Newton steps, starting from the linear regression."""
    blank, demos = problem.blank, problem.demos
    roots = np.sqrt(np.concatenate([demo.weights for demo in demos]))
    y = np.concatenate([demo.y for demo in demos])

    def run(weights: np.ndarray) -> np.ndarray:
        K, paths = len(weights), []
        for k, demo in enumerate(demos):
            ends = (np.broadcast_to(a, (K, blank.n)) for a in (*learned.ends[k], learned.scales[k]))
            paths.append(blank._primitive.rollout(demo.t, problem.tau(demo), *ends, weights)[0])
        return np.concatenate(paths)

    w, inverses, residuals = gauss_newton(run, y, roots, learned.weights)
    return replace(
        learned,
        weights=w,
        unit=inverses,
        sigma=np.sqrt(roots**2 @ residuals**2 / max(len(y) - len(w), 1)),
        residuals=residuals,
        triangle=np.linalg.cholesky(np.linalg.inv(inverses[0])).T,
        of_position=True,
    )


@dataclass(frozen=True)
class _MotionRows:
    """Rows of a demonstration: samples, then standstill. Kernels (R, m), ends (R, 3), square roots of weights (R,)."""

    kernels: np.ndarray
    ends: np.ndarray
    roots: np.ndarray
    pins: np.ndarray  # (3 ends, 3 samples: first, second, last) linear map of the pins
    samples: int


def _motion_rows(problem: WeightProblem, demo: Demo) -> _MotionRows:
    t, N = demo.t, len(demo.t)
    step = demo.duration / (N - 1)
    rest = demo.duration + step * np.arange(1, round(problem.hold * demo.duration / step) + 1)
    finest = demo.duration / FINE * (1 + 1e-9)
    Y, _ = problem.blank._primitive.response(np.concatenate([t, rest]), problem.tau(demo), finest)
    kernels, columns = Y[:, :-3], Y[:, -3:].copy()
    columns[N:, 2] -= 1.0
    pins = np.array([[1.0, 0.0, 0.0], [-1.0 / t[1], 1.0 / t[1], 0.0], [0.0, 0.0, 1.0]])
    pins[[name not in problem.pinned for name in ENDS]] = 0.0
    roots = np.sqrt(np.concatenate([demo.weights, np.ones(len(rest))]))
    return _MotionRows(kernels, columns, roots, pins, N)


def fit_trajectory(problem: WeightProblem) -> Learned:
    """Fit the weights shared by M demonstrations, and the start, velocity and goal of each, to their trajectories.

    The problem is linear and needs no derivatives of measured positions, because the motion is ``y = Y [w; y0; v0; g]``
    with the response Y to each unknown. A pinned end value is a linear function of the samples, so its noise is
    included in the covariance.
    """
    parts = [_motion_rows(problem, demo) for demo in problem.demos]
    free = [k for k, name in enumerate(ENDS) if name not in problem.pinned and name not in problem.known]
    found = [_solve_block(problem, parts, block, free) for block in problem.blocks(alike=True)]
    weights, ends, sigma, residuals = (np.concatenate([one[k] for one in found], axis=-1) for k in (0, 1, 3, 4))
    unit, m = np.concatenate([one[2] for one in found]), len(weights)
    unknowns = (*range(m), *(m + 3 * k + e for k in range(len(parts)) for e in free))
    return Learned(weights, ends, unit, sigma, residuals, found[0][5], unknowns, True, problem.scales)


def _solve_block(
    problem: WeightProblem, parts: list[_MotionRows], block: slice, free: list[int]
) -> tuple[np.ndarray, ...]:
    """Solve for the coordinates that share a matrix."""
    m, M, f, scale = problem.blank.n_basis, len(parts), len(free), problem.scales[:, block.start]
    heights = np.cumsum([0, *(len(p.kernels) for p in parts)])
    A = np.zeros((heights[-1], m + M * f))
    b = np.zeros((heights[-1], block.stop - block.start))
    fixed = np.zeros((M, 3, b.shape[1]))
    for k, (part, demo) in enumerate(zip(parts, problem.demos)):
        rows, y = slice(*heights[k : k + 2]), demo.y[:, block]
        fixed[k] = part.pins @ y[[0, 1, -1]]
        for name, value in problem.known.items():
            fixed[k, ENDS.index(name)] = value[block]
        A[rows, :m] = scale[k] * part.kernels
        A[rows, m + k * f : m + (k + 1) * f] = part.ends[:, free]
        b[rows] = -part.ends @ fixed[k]
        b[rows][: part.samples] += y
        A[rows] *= part.roots[:, None]
        b[rows] *= part.roots[:, None]
    ridge = np.append(np.full(m, problem.ridge), np.zeros(M * f)) if problem.ridge else None
    found = solve(A, b, ridge)
    r = b - A @ found.x
    places = np.concatenate([np.arange(m), *(m + 3 * k + np.array(free, dtype=int) for k in range(M))]).astype(int)
    unit, dof = _covariance(A, found.G, parts, heights, places)
    squares, residuals = np.zeros(b.shape[1]), []
    for k, part in enumerate(parts):
        left, roots = r[heights[k] : heights[k] + part.samples], part.roots[: part.samples, None]
        squares += (left**2).sum(axis=0)
        residuals.append(-left / np.where(roots > 0, roots, 1.0))
    sigma = np.sqrt(squares / max(dof, 1.0))
    fixed[:, free] = found.x[m:].reshape(M, f, b.shape[1])
    each = np.broadcast_to(unit, (len(sigma), *unit.shape))
    return found.x[:m], fixed, each, sigma, np.concatenate(residuals), found.triangle


def _covariance(
    A: np.ndarray, G: np.ndarray, parts: list[_MotionRows], heights: np.ndarray, places: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return the covariance of weights and end values for samples of unit variance, and the residual degrees of
    freedom.

    The unknowns are ``x = G A^T y``, where y contains all samples except the three samples that pin the end values
    and thus shift every row.
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


def _forced(problem: WeightProblem, k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the phase, ``f = tau^2 ydd - alpha_z (beta_z (g - y) - tau yd)`` and start velocity of demonstration k.

    The phase is (N,), or (N, n) with one phase per coordinate.
    """
    blank, demo, goal = problem.blank, problem.demos[k], problem.goals[k]
    velocity, acceleration, tau = demo.velocity, demo.acceleration, problem.tau(demo)
    if problem.bandwidth is not None:
        from armlab.signals import smooth_diff

        velocity = smooth_diff(demo.y, demo.t, problem.bandwidth)
        acceleration = smooth_diff(velocity, demo.t, problem.bandwidth)
    f = tau**2 * acceleration - blank.alpha_z * (blank.beta_z * (goal - demo.y) - tau * velocity)
    by_position = blank.schedule == "position"
    x = progress(demo.y, problem.starts[k], goal) if by_position else blank.phase(demo.t, tau)
    start = problem.known["v0"] if "v0" in problem.known else np.asarray(velocity)[0]
    return x, f, start


def fit_regression(problem: WeightProblem, x: np.ndarray, f: np.ndarray, ends: np.ndarray) -> Learned:
    """Fit weights shared by demonstrations to their forcing f (N, n) at phases x (N,) or (N, n).

    The weights are the least-squares solution or, with method "lwr", the mean weighted by each kernel: ``sum bell x f``
    divided by ``sum bell x^2``. The forcing has the factor x, except with schedule "time".
    """
    blank, m, fades = problem.blank, problem.blank.n_basis, problem.blank.schedule != "time"
    fit = _kernel_by_kernel if problem.method == "lwr" else _least_squares
    weights = np.concatenate([demo.weights for demo in problem.demos])
    scales = np.repeat(problem.scales, [len(demo.t) for demo in problem.demos], axis=0)
    found, left = [], []
    for block in problem.blocks(alike=x.ndim == 1):
        i = block.start
        own = x if x.ndim == 1 else x[:, i]
        rows = _ForcingRows(blank, own, scales[:, i] * (own if fades else 1.0), f[:, block], weights)
        found.append(fit(rows, problem))
        left.append(rows.residuals(found[-1][0]))
    w, squares = (np.concatenate([one[k] for one in found], axis=-1) for k in (0, 3))
    unit = np.concatenate([np.broadcast_to(one[1], (one[0].shape[1], m, m)) for one in found])
    sigma = np.sqrt(squares / max(len(weights) - m, 1))
    residuals = np.concatenate(left, axis=-1)
    return Learned(w, ends, unit, sigma, residuals, found[0][2], tuple(range(m)), False, problem.scales)


@dataclass(frozen=True)
class _ForcingRows:
    """Equations ``lever psi(x) w = f`` of coordinates that share x, lever and sample weights (N,); f (N, q)."""

    blank: Dmp
    x: np.ndarray
    lever: np.ndarray
    f: np.ndarray
    weights: np.ndarray

    def residuals(self, w: np.ndarray) -> np.ndarray:
        return self.f - (self.blank._primitive.basis(self.x) @ w) * self.lever[:, None]


def _least_squares(rows: _ForcingRows, problem: WeightProblem) -> tuple[np.ndarray, ...]:
    """Return the weights, unit covariance, triangular factor and sums of squares."""
    roots, m, (N, q), ridge = np.sqrt(rows.weights), rows.blank.n_basis, rows.f.shape, problem.ridge
    penalty = np.full(m, ridge) if ridge else None
    height = rows_needed(N, m, penalty)
    joined = rows.blank._primitive.design(rows.x, rows.lever * roots, height, m + q).T
    one = solve_joined(joined, rows.f * roots[:, None], penalty)
    if not ridge:
        return one.x, one.G, one.triangle, one.squares
    squares = (one.squares - ridge * (one.x**2).sum(axis=0)).clip(min=0.0)
    return one.x, one.G - ridge * one.G @ one.G, one.triangle, squares


def _kernel_by_kernel(rows: _ForcingRows, problem: WeightProblem) -> tuple[np.ndarray, ...]:
    """Return weights, unit covariance, triangular factor and sums of squares."""
    blank, weights = rows.blank, rows.weights
    bell = blank.kernels(rows.x)
    if problem.raw:
        bell = np.exp(-0.5 * ((rows.x[:, None] - blank.centres) / blank.widths) ** 2)
    top = bell * (weights * rows.lever)[:, None]
    squares = top.T @ rows.lever
    identified = squares > 0
    L = top / np.where(identified, squares, 1.0)
    w = L.T @ rows.f
    spread = (L / np.where(weights > 0, weights, 1.0)[:, None]).T @ L
    return w, spread, np.diag(np.sqrt(squares)), weights @ rows.residuals(w) ** 2


def gauss_newton(
    run: Callable[[np.ndarray], np.ndarray], y: np.ndarray, roots: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the weights (m, n), inverses of the normal matrices (n, m, m) and residuals (N, n), by Gauss-Newton.

    `run` maps weights (K, m, n) to motions (N, K, n). Coordinates are independent, so one weight of each coordinate is
    perturbed at the same time; `roots` (N,) are square roots of the sample weights.
    """
    m, n = weights.shape
    w, damping = weights, np.full(n, DAMPING)
    error, inverses = np.inf, np.empty((n, m, m))
    for _ in range(MAX_ITERATIONS):
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
        if error - total < TOLERANCE * total:
            break
        error = total
    return w, inverses, y - run(w[None])[:, 0]


BLOCK = 8  # LAPACK block size; fastest for about fifty columns
RCOND = 1e-11  # relative singular value below which a direction is set to zero


@dataclass(frozen=True)
class Solution:
    """Least-squares solution of ``A x = b``."""

    x: np.ndarray  # (p, q)
    G: np.ndarray  # (p, p) inverse of the normal matrix
    triangle: np.ndarray  # (p, p) triangle of A
    squares: np.ndarray  # (q,) minimum sums of squares, including penalties


def solve(A: np.ndarray, b: np.ndarray, ridge: np.ndarray | None = None) -> Solution:
    """Minimise ``||A x - b||^2 + sum ridge x^2`` with A (N, p), b (N, q), ridge (p,)."""
    N, p = A.shape
    joined = np.zeros((rows_needed(N, p, ridge), p + b.shape[1]), order="F")
    joined[:N, :p] = A
    return solve_joined(joined, b, ridge)


def rows_needed(N: int, p: int, ridge: np.ndarray | None) -> int:
    """Return the number of rows `solve_joined` needs for N equations in p unknowns."""
    return max(N, p) + (0 if ridge is None else p)


def solve_joined(joined: np.ndarray, b: np.ndarray, ridge: np.ndarray | None = None) -> Solution:
    """Solve as `solve` does, but in place.

    `joined` (rows, p + q), in Fortran order, contains A in its top left corner and zeros elsewhere; the array is
    overwritten.
    """
    p = joined.shape[1] - b.shape[1]
    joined[: len(b), p:] = b
    if ridge is not None:
        joined[-p:, :p] = np.diag(np.sqrt(ridge))
    geqrt, trcon, trtri, trtrs = _lapack()
    factor = np.triu(geqrt(min(BLOCK, *joined.shape), joined, overwrite_a=True)[0][: joined.shape[1]])
    R, rotated, left = factor[:p, :p], factor[:p, p:], factor[p:, p:]
    squares = np.einsum("ij,ij->j", left, left)
    norms = np.sqrt(np.einsum("ij,ij->j", R, R))  # column norms of A; scaling a column of A scales that column of R
    scale = np.where(norms > 0, norms, 1.0)
    scaled = R / scale
    if trcon(scaled)[0] > RCOND:
        inverse, x = trtri(R)[0], trtrs(R, rotated)[0]  # equal to the solution of the scaled equations, up to rounding
    else:
        U, s, V = np.linalg.svd(scaled)
        identified = s > RCOND * s[0]
        inverse = V.T * np.where(identified, 1.0 / np.where(identified, s, 1.0), 0.0) / scale[:, None]
        x = inverse @ (U.T @ rotated)
        squares += ((R @ x - rotated) ** 2).sum(axis=0)
    return Solution(x, inverse @ inverse.T, R, squares)


@cache
def _lapack() -> Any:
    from scipy.linalg import get_lapack_funcs

    return get_lapack_funcs(("geqrt", "trcon", "trtri", "trtrs"), dtype=np.float64)


def block_covariance(unit: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Return the covariance (n d, n d) of n independent coordinates from unit covariances (n, d, d) and noise (n,)."""
    n, d, _ = unit.shape
    cov = np.zeros((n * d, n * d))
    for i, own in enumerate(unit):
        cov.reshape(n, d, n, d)[i, :, i] = own * sigma[i] ** 2
    cov.flags.writeable = False
    return cov
