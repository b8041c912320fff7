"""Linear least squares that outliers do not move: Huber's loss by reweighting, and trimmed blocks.

Huber: minimise ``sum rho(r / s)`` with rho quadratic up to k = 1.345 and linear beyond; every row has the weight
``min(1, k s / |r|)`` and the scale s of each class is the median absolute residual over 0.6745. 95 % efficient for
Gaussian residuals. For rows that are wrong here and there.

Trimmed: keep the 75 % of the blocks of time that fit best together, then every block whose residual fits these. For
stretches of time that are wrong: contact, a collision.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from armlab._numbers import generator, numbers
from armlab.errors import NotExcited, ShapeError, UnknownName
from armlab.estimation.bootstrap import BlockSums
from armlab.estimation.excitation import MAX_CONDITION, Prior
from armlab.estimation.linear_problem import EXACT, LinearProblem, LinearSolution, solve
from armlab.estimation.tsqr import Rows, factorise

HUBER = 1.345
HUBER_ROUNDS, HUBER_STEP = 30, 1e-8  # step in deviations of the estimate
NORMAL_MAD = 0.6744897501960817  # median of |x| for x ~ N(0, 1)
SHARE, STARTS = 0.75, 50
FIRST_STEPS, BEST, LAST_STEPS = 2, 10, 100
CUT = 3.0  # robust deviations of log RMS beyond which a block is left out


def mad(x: np.ndarray) -> float:
    """Return the standard deviation of zero-mean Gaussian x as its outliers do not spoil it: median |x| / 0.6745."""
    return float(np.median(np.abs(numbers(x, "numbers", ShapeError))) / NORMAL_MAD)


def huber(rows: Iterable[Rows], start: LinearSolution) -> LinearSolution:
    """Reweight rows by Huber's loss until the solution stays (Huber and Ronchetti 2009, eq. 7.8 and 7.84)."""
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
    # Blocks of time are kept apart only now: a triangle for each costs more than its rows.
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
    """Yield rows times the root of their Huber weight; collect residuals per class and weights in order."""
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
    """Fit to the blocks of time that agree: least trimmed squares over blocks, then one reweighted step.

    Random small sets of blocks are fitted; each fit is improved by steps that keep the 75 % of the blocks with the
    smallest mean square, which can only lower their sum. Of the best one, the blocks whose log RMS lies within three
    robust deviations of the median are kept for the final weighted fit.

    After Rousseeuw (1984), Least median of squares regression; Rousseeuw and van Driessen (2006), FAST-LTS.
    """
    kept = start.kept
    for _ in range(2):  # the second time with weights of the classes that the outliers did not make
        current = start if kept.all() else solve(start.problem, start.factors, kept=kept)
        whole = replace(current, kept=start.kept)
        kept = _agreeing(BlockSums.of(whole), generator(seed))
    return solve(start.problem, start.factors, kept=kept)


def _agreeing(sums: BlockSums, rng: np.random.Generator) -> np.ndarray:
    """Return which blocks (B,) fit the best trimmed solution."""
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
    """Return the coordinates (r,) fitted to as few random blocks as determine them."""
    order = rng.permutation(blocks)
    r = sums.gram.shape[1]
    count = 1 + int(np.searchsorted(np.cumsum(sums.rows[order]), 2 * r))
    while count <= len(order):
        gram = sums.gram[order[:count]].sum(axis=0)
        if np.linalg.eigvalsh(gram)[0] > 1e-3 * count / len(order):
            return np.linalg.solve(gram, sums.moment[order[:count]].sum(axis=0))
        count += 1 + count // 4
    raise NotExcited(
        f"Expected blocks of time that determine the {sums.solution.problem.what} together, got {len(order)} that do "
        "not. Let every joint move for the whole record.",
        ["blocks"],
        [f"{len(order)} blocks"],
    )


def _concentrate(sums: BlockSums, z: np.ndarray, size: int, steps: int) -> tuple[float, np.ndarray]:
    """Refit to the `size` blocks with the smallest mean square until they stay the same; return their sum and z."""
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
    """Return the mean square (B,) of the weighted residuals per block; inf for blocks that are left out."""
    power = sums.power - 2.0 * sums.moment @ z + (sums.gram @ z) @ z
    level = np.full(len(power), np.inf)
    return np.divide(np.maximum(power, 0.0), sums.rows, out=level, where=sums.rows > 0)


# Linear least squares for any number of rows: one verb, four methods.


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
    """Minimise ``sum_i w_i ||A_i x - y_i||^2`` over classes i of measurement by streaming QR.

    Parameters
    ----------
    rows : of all classes, block by block; may be made on the fly. Memory is O(p^2) per block of time and class.
    names : of the p parameters.
    what : what is fitted, for messages.
    method : "ols": w = 1. "wls": w = 1 / sd^2 of the residuals of each class, found in rounds. "irls": the same with
        Huber's loss; reads the rows once per round. "lts": wls on the blocks of time that agree.
    lower, upper : (p,) bounds; the result says which hold and how much the residual grows by them.
    prior : when given, directions that the data do not tell keep its values and are listed in `excitation.held`.
    max_condition : of the column-scaled, weighted regressor.
    seed : of the random starts of "lts".

    Raises
    ------
    ShapeError : rows or bounds do not fit together or are not finite. UnknownName : another method.
    NotExcited : fewer rows than parameters, or directions that the data do not tell, by name.

    References
    ----------
    Golub and Van Loan (2013), Matrix Computations, chapters 5 and 6. Derivations: docs/theory/estimation.md.
    """
    if method not in METHODS:
        raise UnknownName.among("method of least squares", method, METHODS)
    if method == "irls" and iter(rows) is rows:
        raise ShapeError("Expected rows that can be read again in every round, got a generator. Give a list of Rows.")
    problem = LinearProblem.of(names, what, lower, upper, prior, max_condition)
    factors = factorise(rows, len(names))
    found = solve(problem, factors, np.ones(len(factors.columns)) if method == "ols" else None)
    if method == "irls":
        return huber(rows, found)
    return least_trimmed_squares(found, seed) if method == "lts" else found
