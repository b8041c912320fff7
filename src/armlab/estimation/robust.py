"""Robust linear least squares: Huber's loss by reweighting, and trimmed least squares over time blocks.

Huber: minimise ``sum rho(r / s)`` with rho quadratic up to k = 1.345 and linear beyond. Each row has the weight
``min(1, k s / |r|)``; the scale s of each class is the median absolute residual divided by 0.6745. The estimator is
95 % efficient for Gaussian residuals, and is suited to isolated outliers.

Trimmed: keep the 75 % of the time blocks that fit best together, then add every block consistent with them. This method
handles whole outlier segments, such as contacts and collisions.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from armlab._display import Shown
from armlab._numbers import generator, number, numbers
from armlab.errors import NotExcited, ShapeError, UnknownName
from armlab.estimation.linear_problem import (
    EXACT,
    MAX_CONDITION,
    LinearProblem,
    LinearSolution,
    Prior,
    solve,
    within_bounds,
)
from armlab.estimation.tsqr import Rows, factorise

SHORTEST, CORRELATION_TIMES = 0.5, 4.0  # minimum duration of a block in seconds and in correlation times


def correlation_time(x: np.ndarray, dt: float) -> float:
    """Return the correlation time ``dt (1/2 + sum rho_k)`` [s] of a uniformly sampled record (N,), with the sum over
    positive pairs of rho (Geyer)."""
    x = numbers(x, "a record", ShapeError)
    if x.ndim != 1 or len(x) < 2 or not np.isfinite(x).all():
        raise ShapeError(
            f"Expected a finite record (N,) of at least two samples, got shape {x.shape} with "
            f"{np.count_nonzero(~np.isfinite(x))} NaN or Inf. Drop the missing samples."
        )
    x = x - np.mean(x)
    size = 2 ** int(np.ceil(np.log2(2 * len(x))))
    spectrum = np.fft.rfft(x, size)
    rho = np.fft.irfft(spectrum * np.conj(spectrum), size)[: len(x) // 2]
    if rho[0] <= 0:
        return 0.5 * dt
    rho = rho / rho[0]
    pairs = rho[0 : len(rho) // 2 * 2].reshape(-1, 2).sum(axis=1)
    end = int(np.argmax(pairs <= 0)) if np.any(pairs <= 0) else len(pairs)
    return dt * (pairs[:end].sum() - 0.5)


def effective_samples(x: np.ndarray) -> float:
    """Return the effective sample size of the record x (N,), N > 1, for estimating its mean."""
    return len(x) / max(2.0 * correlation_time(x, 1.0), 1.0)


def block_seconds(residuals: np.ndarray, dt: float) -> float:
    """Return the duration of independent blocks of residuals (N, k): 0.5 s, or 4 correlation times if longer."""
    residuals, dt = numbers(residuals, "residuals", ShapeError), number(dt, "the sampling period [s]")
    return max([SHORTEST, *(CORRELATION_TIMES * correlation_time(column, dt) for column in np.transpose(residuals))])


MIN_BLOCKS = 8  # smallest number of segments for a bootstrap
MIN_EIGENVALUE = 1e-8  # eigenvalue of a resampled normal matrix below which a parameter is undetermined
CHUNK = 64  # resampled normal matrices held in memory


@dataclass(frozen=True, eq=False, repr=False)
class BlockSums(Shown):
    """Sums of the rows per time block, in the coordinates z of ``x = solution.x + solution.basis @ z``.

    In the coordinates z, the whole problem is orthonormal, so the normal equations lose no accuracy.

    Attributes
    ----------
    solution : solution of all blocks.
    gram : (B, r, r) sums U^T U of each block.
    moment : (B, r) sums U^T r of each block.
    power : (B,) sums of squares r^T r of each block.
    rows : (B,) number of rows in each block; zero for blocks excluded from the solution.
    """

    solution: LinearSolution
    gram: np.ndarray
    moment: np.ndarray
    power: np.ndarray
    rows: np.ndarray

    @classmethod
    def of(cls, solution: LinearSolution) -> BlockSums:
        """Sum the rows of a solution per block.

        Parameters
        ----------
        solution : result of `least_squares`; its weights and included blocks are used.
        """
        factors, basis = solution.factors, solution.basis
        B, r = len(factors.rows), basis.shape[1]
        gram, moment, power = np.zeros((B, r, r)), np.zeros((B, r)), np.zeros(B)
        for g, (R, columns) in enumerate(zip(factors.R, factors.columns)):
            rows = R * (solution.weights[g] * solution.kept)[:, None, None]
            U = rows[:, :, :-1] @ basis[columns]
            e = rows @ np.append(-solution.x[columns], 1.0)
            gram += U.transpose(0, 2, 1) @ U
            moment += np.einsum("bij,bi->bj", U, e)
            power += np.sum(e * e, axis=1)
        return cls(solution, gram, moment, power, factors.rows.sum(axis=1) * solution.kept)

    def solve(self, weights: np.ndarray) -> np.ndarray:
        """Return the solutions (..., p) with block weights (..., B), within the bounds.

        Parameters
        ----------
        weights : (..., B) non-negative weights of the blocks; 0 excludes a block.

        Raises
        ------
        NotExcited : the weighted blocks do not determine every parameter.
        """
        flat = np.asarray(weights, dtype=float).reshape(-1, len(self.rows))
        parts = [flat[i : i + CHUNK] for i in range(0, len(flat), CHUNK)]
        solved = np.concatenate([self._solve(part) for part in parts])
        return solved.reshape(*np.shape(weights)[:-1], -1)

    def spread(self, length: int = 1) -> np.ndarray:
        """Return the effective number of segments that determine each parameter (p,), 1 / sum_s h_s^2.

        h_s = b^T G_s b / b^T b is the fraction of the information on the parameter contributed by segment s, where b is
        the parameter's row of `basis`. The result is 1 if a single segment determines the parameter, the number of
        segments for equal fractions, and infinity for a parameter held by a prior.

        Parameters
        ----------
        length : number of blocks per segment.
        """
        b = self.solution.basis
        shares = np.einsum("pi,kij,pj->kp", b, self.gram, b, optimize=True)
        shares = np.add.reduceat(shares, np.arange(0, len(shares), length), axis=0)
        squares = np.sum(shares**2, axis=0)
        return np.divide(shares.sum(axis=0) ** 2, squares, out=np.full(len(b), np.inf), where=squares > 0.0)

    def _solve(self, weights: np.ndarray) -> np.ndarray:
        found, r = self.solution, self.gram.shape[1]
        gram = (weights @ self.gram.reshape(len(self.rows), -1)).reshape(-1, r, r)
        try:
            pivots = np.diagonal(np.linalg.cholesky(gram), axis1=1, axis2=2) ** 2
        except np.linalg.LinAlgError:
            pivots = np.zeros((1, 1))
        if not np.all(pivots.min(axis=1, initial=np.inf) > MIN_EIGENVALUE * weights.max(axis=1)):
            raise NotExcited(
                f"Expected every resample of the time blocks to determine the {found.problem.what}, but a resample of "
                f"the {np.count_nonzero(self.rows)} blocks leaves a parameter undetermined. Move every joint "
                "throughout the recording.",
                ["a parameter determined by few blocks"],
                [f"{np.count_nonzero(self.rows)} blocks"],
            )
        z = np.linalg.solve(gram, (weights @ self.moment)[:, :, None])[:, :, 0]
        x = found.x + z @ found.basis.T
        lower, upper = found.problem.lower, found.problem.upper
        for i in np.flatnonzero(np.any((x < lower) | (x > upper), axis=1)):
            cov = found.scale**2 * found.basis @ np.linalg.solve(gram[i], found.basis.T)
            x[i] = within_bounds(x[i], cov + found.held_cov, lower, upper)
        return x


@dataclass(frozen=True, eq=False, repr=False)
class Bootstrap(Shown):
    """Result of a block bootstrap.

    Attributes
    ----------
    draws : array, shape (D, p), units of the parameters
        Solutions of the resampled problems.
    cov : array, shape (p, p), units of the parameters
        Covariance of the estimate: covariance of the draws, shrunk towards a multiple of the formal covariance.
    shrinkage : float
        Amount of shrinkage, from 0 to 1; near 1 for few blocks and many parameters.
    """

    draws: np.ndarray
    cov: np.ndarray
    shrinkage: float

    def interval(self, level: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower and upper ends (p,) of the percentile interval."""
        tail = 50.0 * (1.0 - level)
        low, high = np.percentile(self.draws, [tail, 100.0 - tail], axis=0)
        return low, high


def block_bootstrap(sums: BlockSums, draws: int | None = None, seed: int = 0, length: int = 1) -> Bootstrap:
    """Bootstrap a linear solution: resample circular segments of whole blocks with replacement, and solve again.

    The covariance S of the draws has the correct scale, but the number of segments limits its rank, so its inverse
    would be far too large. S is therefore shrunk to ``(1 - d) S + d trace(S) / p`` in coordinates with unit formal
    covariance; the scatter of the segments determines d (Ledoit and Wolf).

    Parameters
    ----------
    sums : block sums that form at least 8 segments.
    draws : number of draws; default: the larger of 200 and 4 p.
    seed : seed of the random generator.
    length : number of blocks per segment; a segment should last at least 0.5 s and 4 correlation times.

    Raises
    ------
    ShapeError : fewer than 8 segments or 2 draws.
    NotExcited : a bootstrap sample does not determine every parameter.

    References
    ----------
    Politis and Romano (1992), A circular block-resampling procedure; Kunsch (1989). Fixed robust weights with scaled
    standard deviations: Salibian-Barrera and Zamar (2002), Bootstrapping robust estimates of regression. Shrinkage:
    Ledoit and Wolf (2004), A well-conditioned estimator for large-dimensional covariance matrices.
    """
    blocks = np.flatnonzero(sums.rows)
    count = len(blocks)
    if length < 1 or count < MIN_BLOCKS * length:
        raise ShapeError(
            f"Expected at least {MIN_BLOCKS} segments of {length} blocks, got {count} blocks. Record a longer log."
        )
    found = sums.solution
    number = max(200, 4 * len(found.x)) if draws is None else draws
    if number < 2:
        raise ShapeError(f"Expected at least 2 draws for a covariance, got {number}. Omit draws to use the default.")
    starts = generator(seed).integers(count, size=(number, -(-count // length)))
    chosen = (starts[:, :, None] + np.arange(length)).reshape(number, -1)[:, :count] % count
    weights = np.zeros((number, len(sums.rows)))
    np.add.at(weights, (np.arange(number)[:, None], blocks[chosen]), 1.0)
    solved = found.x + found.stretch * (sums.solve(weights) - found.x)
    coordinates = (solved - solved.mean(axis=0)) @ np.linalg.pinv(found.basis).T  # with respect to basis
    whole, S = count // length * length, coordinates.T @ coordinates / (number - 1)
    share = shrinkage(np.add.reduceat(sums.moment[blocks[:whole]], np.arange(0, whole, length), 0))
    S = (1.0 - share) * S + share * np.trace(S) / len(S) * np.eye(len(S))
    cov = found.basis @ S @ found.basis.T + found.held_cov
    return Bootstrap(solved, 0.5 * (cov + cov.T), share)  # exactly symmetric, as stored in files


def shrinkage(scores: np.ndarray) -> float:
    """Return d (0 to 1) for which ``(1 - d) S + d trace(S) / p`` is closer to the true covariance than ``S = scores^T
    scores``.

    `scores` (B, p) are gradients of B independent segments in coordinates with unit formal covariance (Ledoit and Wolf
    2004, lemma 3.2).
    """
    S, count = scores.T @ scores, len(scores)
    away = S - np.trace(S) / len(S) * np.eye(len(S))
    spread = float(np.sum(away * away))
    fourth = float(np.sum(np.sum(scores * scores, axis=1) ** 2)) - float(np.sum(S * S)) / count
    return min(1.0, fourth / spread) if spread > 0 else 1.0


@dataclass(frozen=True, eq=False, repr=False)
class CrossValidation(Shown):
    """Held-out errors of block cross-validation.

    Attributes
    ----------
    fold : int array, shape (B,)
        Fold of each block; -1 for blocks excluded from the fit.
    solutions : array, shape (k, p), units of the parameters
        Leave-one-fold-out solutions.
    rms : array, shape (k, G), units of the measurements
        Held-out RMS residual of each fold and measurement class.
    """

    fold: np.ndarray
    solutions: np.ndarray
    rms: np.ndarray


def block_cv(sums: BlockSums, folds: int = 7, mode: str = "contiguous") -> CrossValidation:
    """Cross-validate over time blocks.

    Parameters
    ----------
    sums : block sums of the whole problem.
    folds : number of folds.
    mode : "contiguous": each fold is one contiguous time segment; the test is unbiased. "alternate": blocks are
        assigned to folds cyclically, as in published results; the test is optimistic because neighbouring blocks are
        correlated.

    Raises
    ------
    ShapeError : fewer blocks than folds.
    UnknownName : unknown mode.
    NotExcited : a training set does not determine all parameters.
    """
    blocks = np.flatnonzero(sums.rows)
    if not 2 <= folds <= len(blocks):
        raise ShapeError(
            f"Expected 2 to {len(blocks)} folds for {len(blocks)} blocks, got {folds}. Record a longer log."
        )
    modes = {"contiguous": np.arange(len(blocks)) * folds // len(blocks), "alternate": np.arange(len(blocks)) % folds}
    if mode not in modes:
        raise UnknownName.among("mode of cross-validation", mode, modes)
    fold = np.full(len(sums.rows), -1)
    fold[blocks] = modes[mode]
    solutions = sums.solve((fold >= 0) & (fold != np.arange(folds)[:, None]))
    measured = sums.solution.measured
    rms = []
    for k, x in enumerate(solutions):
        power, rows = measured.power(x)[fold == k].sum(axis=0), measured.rows[fold == k].sum(axis=0)
        rms.append(np.sqrt(power / np.maximum(rows, 1)))
    return CrossValidation(fold, solutions, np.stack(rms))


HUBER = 1.345  # standard deviations beyond which the loss is linear
HUBER_ROUNDS, HUBER_STEP = 30, 1e-8  # maximum number of iterations; step at convergence, in standard deviations
NORMAL_MAD = 0.6744897501960817  # median of |x| for x ~ N(0, 1)
SHARE, STARTS = 0.75, 50  # fraction of the blocks in a trimmed fit; number of random starts
FIRST_STEPS, BEST, LAST_STEPS = 2, 10, 100  # steps per start; number of starts continued, and maximum steps of each
CUT = 3.0  # robust standard deviations of log RMS above which a block is excluded


def mad(x: np.ndarray) -> float:
    """Return the robust standard deviation of zero-mean Gaussian samples: median |x| / 0.6745."""
    return float(np.median(np.abs(x)) / NORMAL_MAD)


def huber(rows: Iterable[Rows], start: LinearSolution) -> LinearSolution:
    """Reweight rows by Huber's loss until convergence (Huber and Ronchetti 2009, eq. 7.8 and 7.84)."""
    found, x, sigma, used, step = start, start.x, start.sigma, start.sigma, np.inf
    residuals: dict[int, list[np.ndarray]] = {}
    weights: list[np.ndarray] = []
    rounds = 0
    while rounds < HUBER_ROUNDS and step > HUBER_STEP:
        rounds += 1
        x, used = found.x, sigma
        residuals, weights = {}, []
        pieces = _reweighted(rows, x, used, residuals, weights)
        whole = (replace(piece, block=np.zeros_like(piece.block)) for piece in pieces)
        found = solve(start.problem, factorise(whole, len(x)), 1.0 / used)
        step = np.linalg.norm(found.R @ (found.x - x)) / (max(found.scale, 1e-300) * np.sqrt(len(x)))
        sigma = np.array([mad(np.concatenate(residuals[g])) if g in residuals else s for g, s in enumerate(used)])
        sigma = np.maximum(sigma, EXACT * start.sigma)
    # Only the final pass factorises the blocks separately, because one triangular factor per block is slower.
    found = solve(start.problem, factorise(_reweighted(rows, x, used, {}, []), len(x)), 1.0 / used)
    scaled = np.concatenate([np.concatenate(r) / used[g] for g, r in residuals.items()])
    return _finish(start, found, scaled, used, np.concatenate(weights), rounds, bool(step <= HUBER_STEP))


def _reweighted(
    rows: Iterable[Rows],
    x: np.ndarray,
    sigma: np.ndarray,
    residuals: dict[int, list[np.ndarray]],
    weights: list[np.ndarray],
) -> Iterator[Rows]:
    """Yield the rows scaled by the square root of their Huber weight; collect the residuals per class and the
    weights."""
    for piece in rows:
        e = piece.y - piece.A @ (x if piece.columns is None else x[piece.columns])
        residuals.setdefault(piece.group, []).append(e)
        limit = HUBER * sigma[piece.group]
        weight = np.divide(limit, np.abs(e), out=np.ones_like(e), where=np.abs(e) > limit)
        weights.append(weight)
        root = np.sqrt(weight)
        yield replace(piece, A=piece.A * root[:, None], y=piece.y * root)


def _finish(
    start: LinearSolution,
    found: LinearSolution,
    scaled: np.ndarray,
    sigma: np.ndarray,
    row_weights: np.ndarray,
    rounds: int,
    converged: bool,
) -> LinearSolution:
    """Return the solution with the covariance of an M-estimator: ``K^2 mean(psi^2) / mean(psi')^2 (A^T A)^-1``."""
    N, p = len(scaled), found.basis.shape[1]
    inside = float(np.mean(np.abs(scaled) <= HUBER))
    psi2 = float(np.sum(np.minimum(np.abs(scaled), HUBER) ** 2) / max(N - p, 1))
    small_sample = 1.0 + p / N * (1.0 - inside) / inside
    plain = solve(start.problem, start.factors, 1.0 / sigma)
    variance = (small_sample**2 * psi2 / inside**2) / plain.scale**2
    return replace(
        found,
        cov=(plain.cov - plain.held_cov) * variance + plain.held_cov,
        sigma=sigma,
        measured=start.factors,
        stretch=float(np.mean(row_weights) / inside),
        row_weights=row_weights,
        rounds=rounds,
        converged=converged,
    )


def least_trimmed_squares(start: LinearSolution, seed: int = 0) -> LinearSolution:
    """Fit to the mutually consistent time blocks (FAST-LTS, Rousseeuw and van Driessen 2006), then reweight once."""
    kept = start.kept
    for _ in range(2):  # the second pass uses class weights estimated without outliers
        current = start if kept.all() else solve(start.problem, start.factors, kept=kept)
        whole = replace(current, kept=start.kept)
        kept = _consistent_blocks(BlockSums.of(whole), generator(seed))
    return solve(start.problem, start.factors, kept=kept)


def _consistent_blocks(sums: BlockSums, rng: np.random.Generator) -> np.ndarray:
    """Return the blocks (B,) consistent with the best trimmed solution."""
    blocks = np.flatnonzero(sums.rows)
    size = int(np.ceil(SHARE * len(blocks)))
    starts = [_concentrate(sums, _random_start(sums, blocks, rng), size, FIRST_STEPS) for _ in range(STARTS)]
    starts.sort(key=lambda candidate: candidate[0])
    best = min((_concentrate(sums, z, size, LAST_STEPS) for _, z in starts[:BEST]), key=lambda candidate: candidate[0])
    level = np.log(np.maximum(_mean_square(sums, best[1]), 1e-300))[blocks]
    middle = np.median(level)
    kept = np.zeros(len(sums.rows), dtype=bool)
    kept[blocks[level <= middle + CUT * mad(level - middle)]] = True
    return kept


def _random_start(sums: BlockSums, blocks: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the coordinates (r,) fitted to a minimal random set of blocks."""
    order = rng.permutation(blocks)
    r = sums.gram.shape[1]
    count = 1 + int(np.searchsorted(np.cumsum(sums.rows[order]), 2 * r))
    while count <= len(order):
        gram = sums.gram[order[:count]].sum(axis=0)
        if np.linalg.eigvalsh(gram)[0] > 1e-3 * count / len(order):
            return np.linalg.solve(gram, sums.moment[order[:count]].sum(axis=0))
        count += 1 + count // 4
    raise NotExcited(
        f"Expected time blocks that together determine the {sums.solution.problem.what}, got {len(order)} blocks "
        "with too little excitation. Move every joint throughout the recording.",
        ["blocks"],
        [f"{len(order)} blocks"],
    )


def _concentrate(sums: BlockSums, z: np.ndarray, size: int, steps: int) -> tuple[float, np.ndarray]:
    """Refit to the `size` blocks with the smallest mean squares until convergence; return the sum of squares and the
    solution z."""
    cost, before = np.inf, None
    for _ in range(steps):
        level = _mean_square(sums, z)
        chosen = np.sort(np.argsort(level, kind="stable")[:size])
        cost = float(level[chosen].sum())
        if before is not None and np.array_equal(chosen, before):
            break
        before = chosen
        gram = sums.gram[chosen].sum(axis=0)
        z = np.linalg.solve(gram, sums.moment[chosen].sum(axis=0))
    return cost, z


def _mean_square(sums: BlockSums, z: np.ndarray) -> np.ndarray:
    """Return the mean square (B,) of the weighted residuals per block; infinity for excluded blocks."""
    power = sums.power - 2.0 * sums.moment @ z + (sums.gram @ z) @ z
    level = np.full(len(power), np.inf)
    return np.divide(np.maximum(power, 0.0), sums.rows, out=level, where=sums.rows > 0)


INLIERS = 0.6  # assumed fraction of inliers
SUBSETS, REFINED_SETS, IMPROVED = 300, 5, 10  # numbers of minimal subsets, refined fits and refinement steps
UNOBSERVABLE = 1e-9  # relative singular value


def majority_step(J: np.ndarray, r: np.ndarray, sample: np.ndarray, label: np.ndarray, count: int) -> np.ndarray:
    """Return the step (d,) of the linearised problem from a value biased by outliers to the fit of the majority of the
    samples.

    Fits to random minimal subsets are refined on the samples that fit best and selected by the median residual of each
    class (least trimmed squares, Rousseeuw and van Driessen 2006). `sample` (0 to `count` - 1) and `label` (class)
    index the whitened rows J and r (M,).
    """
    d, rng = J.shape[1], np.random.default_rng(0)
    most, numbers = int(np.ceil(INLIERS * count)), max(1, len(r) // count)
    few = min(most, -(-(d + 1) // numbers))

    def refitted(kept: np.ndarray, scale: np.ndarray) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
        """Fit the `kept` samples; return the score, the step, the best-fitting samples, and the scales (M,)."""
        chosen = np.isin(sample, kept)
        x = np.linalg.lstsq(J[chosen] / scale[chosen, None], -r[chosen] / scale[chosen], rcond=UNOBSERVABLE)[0]
        left = np.abs(r + J @ x)
        sizes = np.array([max(np.median(left[label == c]), 1e-300) for c in range(int(label.max()) + 1)])
        away = np.bincount(sample, (left / sizes[label]) ** 2, minlength=count)
        return float(np.sum(np.log(sizes))), x, np.argsort(away, kind="stable")[:most], sizes[label]

    found = []
    for _ in range(SUBSETS):
        one = refitted(rng.choice(count, few, replace=False), np.ones(len(r)))
        found.append(min((one, refitted(*one[2:])), key=lambda each: each[0]))
    best = sorted(found, key=lambda each: each[0])[:REFINED_SETS]
    for _ in range(IMPROVED):
        best = [min((one, refitted(*one[2:])), key=lambda each: each[0]) for one in best]
    return min(best, key=lambda each: each[0])[1]


METHODS = ("ols", "wls", "irls", "lts")


def least_squares(
    rows: Iterable[Rows],
    names: Sequence[str],
    *,
    what: str = "model",
    method: str = "wls",
    lower: np.ndarray | None = None,
    upper: np.ndarray | None = None,
    prior: Prior | None = None,
    max_condition: float = MAX_CONDITION,
    seed: int = 0,
) -> LinearSolution:
    """Minimise ``sum_i w_i ||A_i x - y_i||^2`` over the measurement classes i by streaming QR.

    Parameters
    ----------
    rows : rows of all classes, block by block; may be a generator. Memory is O(p^2) per time block and class.
    names : names of the p parameters.
    what : name of the fitted quantity, for messages.
    method : "ols": w = 1. "wls": w = 1 / sd^2 of the residuals of each class, iterated. "irls": wls with Huber's loss,
        reading the rows once per iteration. "lts": wls on the mutually consistent time blocks.
    lower, upper : (p,) bounds; the result lists the active bounds and how much they increase the residual.
    prior : prior values, which are kept along undetermined directions; `excitation.held` lists these directions.
    max_condition : largest accepted condition number of the column-scaled, weighted regressor.
    seed : seed of the random starts of "lts".

    Raises
    ------
    ShapeError : rows or bounds with inconsistent shapes, or with NaN or infinity.
    UnknownName : unknown method.
    NotExcited : too few rows, or undetermined directions (named in the message).

    References
    ----------
    Golub and Van Loan (2013), Matrix Computations, chapters 5 and 6. Derivations: docs/theory/estimation.md.
    """
    if method not in METHODS:
        raise UnknownName.among("method of least squares", method, METHODS)
    if method == "irls" and iter(rows) is rows:
        raise ShapeError("Expected rows that can be iterated repeatedly, got a generator. Pass a list of Rows.")
    problem = LinearProblem.of(names, what, lower, upper, prior, max_condition)
    factors = factorise(rows, len(names))
    found = solve(problem, factors, np.ones(len(factors.columns)) if method == "ols" else None)
    if method == "irls":
        return huber(rows, found)
    return least_trimmed_squares(found, seed) if method == "lts" else found
