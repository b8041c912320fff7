"""Weights of a movement primitive from demonstrations: by its own motion, or by the forcing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from armlab.motion.dmp import Dmp
from armlab.motion.primitive.demonstrations import Demo
from armlab.motion.primitive.run import progress

ENDS = ("y0", "v0", "g")
FINE = 1000  # steps of the response over a duration, at least

ROUNDS = 20
ENOUGH = 1e-6  # relative gain of the error below which to stop
STEP = 1e-6  # of the largest weight, for the slopes
DAMPING = 1e-8  # of the mean square of a column


@dataclass(frozen=True)
class Learned:
    """Weights (m, n); y0, v0, g of each demonstration (M, 3, n); covariances (n, d, d) of weights, and of the ends
    where they were fitted too, for noise of unit variance; noise (n,); residuals (N, n), of position or of the forcing;
    triangle of the unknowns and their numbers; scales (M, n)."""

    weights: np.ndarray
    ends: np.ndarray
    unit: np.ndarray
    sigma: np.ndarray
    residuals: np.ndarray
    triangle: np.ndarray
    unknowns: tuple[int, ...]
    of_position: bool
    scales: np.ndarray

    def path(self, dmp: Dmp, demo: Demo, k: int) -> np.ndarray:
        """Return the motion (N, n) of demonstration k."""
        y0, v0, g = self.ends[k]
        tau = dmp.tau_d * demo.duration / dmp.duration
        return dmp._primitive.rollout(demo.t, tau, y0, v0, g, np.ascontiguousarray(self.scales[k]))[0]


@dataclass(frozen=True)
class WeightProblem:
    """A primitive without weights, demonstrations with scales, starts and goals (M, n), ends, options of `fit_dmp`."""

    method: str
    blank: Dmp
    demos: list[Demo]
    scales: np.ndarray
    starts: np.ndarray
    goals: np.ndarray
    ends: Ends
    hold: float
    ridge: float
    bandwidth: float | None
    raw: bool

    def of_each(self) -> list[WeightProblem]:
        """Return the problem of each demonstration alone."""
        parts = zip(self.demos, self.scales, self.starts, self.goals)
        return [replace(self, demos=[d], scales=s[None], starts=a[None], goals=b[None]) for d, s, a, b in parts]


def learn(problem: WeightProblem) -> Learned:
    """Learn weights that M demonstrations share."""
    blank, demos, scales, ends = problem.blank, problem.demos, problem.scales, problem.ends
    m = blank.n_basis
    if problem.method == "trajectory" and blank.schedule != "position":
        taus = [blank.tau_d * demo.duration / blank.duration for demo in demos]
        found = fit_trajectory(blank._primitive, demos, taus, scales, ends, problem.hold, problem.ridge)
        unknowns = (*range(m), *(m + 3 * k + e for k in range(len(demos)) for e in found.free))
        parts = found.weights, found.ends, found.unit, found.sigma, found.residuals, found.triangle
        return Learned(*parts, unknowns, True, scales)
    velocities = [_velocity(demo, problem.bandwidth) for demo in demos]
    speeds = [ends.known.get("v0", v[0]) for v, _ in velocities]
    all_ends = np.stack([problem.starts, np.array(speeds), problem.goals], axis=1)
    forced = [
        _forced(blank, demo, *velocity, scale, start, goal)
        for demo, velocity, scale, start, goal in zip(demos, velocities, scales, problem.starts, problem.goals)
    ]
    bells = (blank.centres, blank.widths if problem.raw else np.zeros(0)) if problem.method == "lwr" else None
    first = fit_regression(forced, blank._primitive, m, blank.schedule != "time", problem.ridge, bells)
    parts = first.unit, first.sigma, first.residuals, first.triangle
    learned = Learned(first.weights, all_ends, *parts, tuple(range(m)), False, scales)
    return learned if problem.method != "trajectory" else _descended(blank, demos, learned)


def _velocity(demo: Demo, bandwidth: float | None) -> tuple[np.ndarray, np.ndarray]:
    if bandwidth is None:
        return demo.velocity, demo.acceleration
    from armlab.signals import smooth_diff

    velocity = smooth_diff(demo.y, demo.t, bandwidth)
    return velocity, smooth_diff(velocity, demo.t, bandwidth)


def _forced(
    blank: Dmp,
    demo: Demo,
    velocity: np.ndarray,
    acceleration: np.ndarray,
    scale: np.ndarray,
    start: np.ndarray,
    goal: np.ndarray,
) -> Forced:
    """Return the forcing that the spring leaves: ``tau^2 ydd - alpha_z (beta_z (g - y) - tau yd)``, and its phase."""
    tau = blank.tau_d * demo.duration / blank.duration
    f = tau**2 * acceleration - blank.alpha_z * (blank.beta_z * (goal - demo.y) - tau * velocity)
    x = progress(demo.y, start, goal) if blank.schedule == "position" else blank.phase(demo.t, tau)
    return Forced(x, f, scale, demo.weights)


def _descended(blank: Dmp, demos: list[Demo], learned: Learned) -> Learned:
    """Return weights of a position phase, from the regression on."""
    roots = np.sqrt(np.concatenate([demo.weights for demo in demos]))
    y = np.concatenate([demo.y for demo in demos])

    def run(weights: np.ndarray) -> np.ndarray:
        K, paths = len(weights), []
        for k, demo in enumerate(demos):
            tau = blank.tau_d * demo.duration / blank.duration
            ends = (np.broadcast_to(a, (K, blank.n)) for a in (*learned.ends[k], learned.scales[k]))
            paths.append(blank._primitive.rollout(demo.t, tau, *ends, weights)[0])
        return np.concatenate(paths)

    w, inverses, residuals = descend(run, y, roots, learned.weights)
    dof = max(len(y) - len(w), 1)
    sigma = np.sqrt(roots**2 @ residuals**2 / dof)
    return replace(
        learned,
        weights=w,
        unit=inverses,
        sigma=sigma,
        residuals=residuals,
        triangle=np.linalg.cholesky(np.linalg.inv(inverses[0])).T,
        of_position=True,
    )


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
class _MotionRows:
    """Rows of one demonstration: samples, then rest at the goal. kernels (R, m), ends (R, 3), root weights (R,)."""

    kernels: np.ndarray
    ends: np.ndarray
    roots: np.ndarray
    pins: np.ndarray  # (3 ends, 3 samples: first, second, last) what is pinned to them
    samples: int


def _motion_rows(primitive: Any, demo: Demo, tau: float, hold: float, ends: Ends) -> _MotionRows:
    t, N = demo.t, len(demo.t)
    step = demo.duration / (N - 1)
    rest = demo.duration + step * np.arange(1, round(hold * demo.duration / step) + 1)
    Y, _ = primitive.response(np.concatenate([t, rest]), tau, demo.duration / FINE * (1 + 1e-9))
    kernels, columns = Y[:, :-3], Y[:, -3:].copy()
    columns[N:, 2] -= 1.0
    pins = np.array([[1.0, 0.0, 0.0], [-1.0 / t[1], 1.0 / t[1], 0.0], [0.0, 0.0, 1.0]])
    pins[[name not in ends.pinned for name in ENDS]] = 0.0
    roots = np.sqrt(np.concatenate([demo.weights, np.ones(len(rest))]))
    return _MotionRows(kernels, columns, roots, pins, N)


def fit_trajectory(
    primitive: Any,
    demos: Sequence[Demo],
    taus: Sequence[float],
    scales: np.ndarray,
    ends: Ends,
    hold: float,
    ridge: float,
) -> Found:
    """Fit weights that M demonstrations share, and the ends of each, by their own motion.

    Linear, without derivatives of measured positions: the motion is ``y = Y [w; y0; v0; g]`` with the response Y of
    each alone. A pinned end is a linear function of the samples too, so its noise is in the covariance. `hold` is the
    rest at the goal after the end, over the duration.
    """
    parts = [_motion_rows(primitive, demo, tau, hold, ends) for demo, tau in zip(demos, taus)]
    free = tuple(k for k, name in enumerate(ENDS) if name not in ends.pinned and name not in ends.known)
    same = bool((scales == scales[:, :1]).all())
    n = scales.shape[1]
    blocks = [slice(0, n)] if same else [slice(i, i + 1) for i in range(n)]
    found = [_solve_block(parts, demos, scales[:, block][:, 0], block, ends, free, ridge) for block in blocks]
    weights, all_ends, sigma, residuals = (np.concatenate([one[k] for one in found], axis=-1) for k in (0, 1, 3, 4))
    return Found(weights, all_ends, np.concatenate([one[2] for one in found]), sigma, residuals, found[0][5], free)


def _solve_block(
    parts: list[_MotionRows],
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
    unit, dof = _covariance(A, found.G, parts, heights, places)
    squares, residuals = np.zeros(b.shape[1]), []
    for k, part in enumerate(parts):
        left, roots = r[heights[k] : heights[k] + part.samples], part.roots[: part.samples, None]
        squares += (left**2).sum(axis=0)
        residuals.append(-left / np.where(roots > 0, roots, 1.0))
    sigma = np.sqrt(squares / max(dof, 1.0))
    fixed[:, list(free)] = found.x[m:].reshape(M, f, b.shape[1])
    each = np.broadcast_to(unit, (len(sigma), *unit.shape))
    return found.x[:m], fixed, each, sigma, np.concatenate(residuals), found.triangle


def _covariance(
    A: np.ndarray, G: np.ndarray, parts: list[_MotionRows], heights: np.ndarray, places: np.ndarray
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
    residuals: np.ndarray
    triangle: np.ndarray


def fit_regression(
    demos: Sequence[Forced],
    primitive: Any,
    m: int,
    fades: bool,
    ridge: float,
    bells: tuple[np.ndarray, np.ndarray] | None,
) -> Regression:
    """Fit weights that demonstrations share to their forcing, which has the factor x where it `fades`.

    By least squares without `bells`; with them, centres and widths, each weight is a mean weighed by its own bell,
    ``sum bell x f / sum bell x^2`` (empty widths: normalised kernels).
    """
    n = demos[0].f.shape[1]
    scales = np.array([demo.scale for demo in demos])
    alike = demos[0].x.ndim == 1 and bool((scales == scales[:, :1]).all())
    found, left = [], []
    for block in [slice(0, n)] if alike else [slice(i, i + 1) for i in range(n)]:
        i = block.start
        x = _joined([demo.x if demo.x.ndim == 1 else demo.x[:, i] for demo in demos])
        lever = np.repeat(scales[:, i], [len(demo.f) for demo in demos]) * (x if fades else 1.0)
        rows = _ForcingRows(primitive, m, x, lever, _joined([demo.f[:, block] for demo in demos]))
        weights = _joined([demo.weights for demo in demos])
        one = _least_squares(rows, weights, ridge) if bells is None else _kernel_by_kernel(rows, weights, *bells)
        found.append(one)
        left.append(rows.residuals(one[0]))
    w, squares = (np.concatenate([one[k] for one in found], axis=-1) for k in (0, 3))
    N = sum(len(demo.f) for demo in demos)
    return Regression(
        w,
        np.concatenate([np.broadcast_to(one[1], (one[0].shape[1], m, m)) for one in found]),
        np.sqrt(squares / max(N - m, 1)),
        np.concatenate(left, axis=-1),
        found[0][2],
    )


def _joined(parts: list[np.ndarray]) -> np.ndarray:
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


@dataclass(frozen=True)
class _ForcingRows:
    """Equations ``lever psi(x) w = f`` of coordinates that share x (N,) and lever (N,); psi (N, m), f (N, q)."""

    primitive: Any
    m: int
    x: np.ndarray
    lever: np.ndarray
    f: np.ndarray

    def residuals(self, w: np.ndarray) -> np.ndarray:
        return self.f - (self.primitive.basis(self.x) @ w) * self.lever[:, None]


def _least_squares(rows: _ForcingRows, weights: np.ndarray, ridge: float) -> tuple[np.ndarray, ...]:
    """Return weights, unit covariance, triangle and sums of squares."""
    roots, m, (N, q) = np.sqrt(weights), rows.m, rows.f.shape
    penalty = np.full(m, ridge) if ridge else None
    joined = rows.primitive.design(rows.x, rows.lever * roots, rows_needed(N, m, penalty), m + q).T
    one = solve_joined(joined, rows.f * roots[:, None], penalty)
    if not ridge:
        return one.x, one.G, one.triangle, one.squares
    squares = (one.squares - ridge * (one.x**2).sum(axis=0)).clip(min=0.0)
    return one.x, one.G - ridge * one.G @ one.G, one.triangle, squares


def _kernel_by_kernel(
    rows: _ForcingRows, weights: np.ndarray, centres: np.ndarray, widths: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Return weights, unit covariance, triangle and sums of squares."""
    if len(widths):
        bell = np.exp(-0.5 * ((rows.x[:, None] - centres) / widths) ** 2)
    else:
        bell = rows.primitive.basis(rows.x)
    top = bell * (weights * rows.lever)[:, None]
    squares = top.T @ rows.lever
    identified = squares > 0
    L = top / np.where(identified, squares, 1.0)
    w = L.T @ rows.f
    spread = (L / np.where(weights > 0, weights, 1.0)[:, None]).T @ L
    return w, spread, np.diag(np.sqrt(squares)), weights @ rows.residuals(w) ** 2


def descend(
    run: Callable[[np.ndarray], np.ndarray], y: np.ndarray, roots: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return weights (m, n), inverses of the normal matrices (n, m, m) and residuals (N, n), by Gauss-Newton.

    `run` maps weights (K, m, n) to motions (N, K, n). Coordinates are independent, so one weight of each is moved at
    once; `roots` (N,) are square roots of the weights of the samples.
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


BLOCK = 8  # columns that are reflected together: the fastest for some fifty of them
RCOND = 1e-11  # relative singular value below which a direction is left at zero


@dataclass(frozen=True)
class Solution:
    """Solution x (p, q) of ``A x = b``, the inverse G (p, p) of the normal matrix, the triangle (p, p) of A, and the
    least sums of squares (q,), penalties included."""

    x: np.ndarray
    G: np.ndarray
    triangle: np.ndarray
    squares: np.ndarray


def solve(A: np.ndarray, b: np.ndarray, ridge: np.ndarray | None = None) -> Solution:
    """Minimise ``||A x - b||^2 + sum ridge x^2`` with A (N, p), b (N, q), ridge (p,)."""
    N, p = A.shape
    joined = np.zeros((rows_needed(N, p, ridge), p + b.shape[1]), order="F")
    joined[:N, :p] = A
    return solve_joined(joined, b, ridge)


def rows_needed(N: int, p: int, ridge: np.ndarray | None) -> int:
    """Return how many rows `solve_joined` needs for N equations of p unknowns."""
    return max(N, p) + (0 if ridge is None else p)


def solve_joined(joined: np.ndarray, b: np.ndarray, ridge: np.ndarray | None = None) -> Solution:
    """Solve in place: `joined` (rows, p + q) in Fortran order has A in its corner, otherwise 0, and is overwritten."""
    p = joined.shape[1] - b.shape[1]
    joined[: len(b), p:] = b
    if ridge is not None:
        joined[-p:, :p] = np.diag(np.sqrt(ridge))
    geqrt, trcon, trtri, trtrs = _lapack()
    factor = np.triu(geqrt(min(BLOCK, *joined.shape), joined, overwrite_a=True)[0][: joined.shape[1]])
    R, rotated, left = factor[:p, :p], factor[:p, p:], factor[p:, p:]
    squares = np.einsum("ij,ij->j", left, left)
    norms = np.sqrt(np.einsum("ij,ij->j", R, R))  # of the columns of A; a reflection scales with its column
    scale = np.where(norms > 0, norms, 1.0)
    scaled = R / scale
    if trcon(scaled)[0] > RCOND:
        inverse, x = trtri(R)[0], trtrs(R, rotated)[0]  # the same with columns scaled, but for rounding
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
