"""Friction's share of the covariance that short blocks of time do not show: drift along the log, and rival structures.

The block bootstrap sees what changes from one half second to the next. Offsets that drift and drives that warm up
change slowly, and another log may win by other terms of friction; both are added to the covariance of its residuals.

Drift. With the solution held, the first and the second half of the log have their own change of each joint's viscous
and Coulomb friction and offset. The squared difference of the halves, less its sampling variance, is pooled over the
joints, relative to the torque of their friction: one joint alone would be one degree of freedom. A random walk lets
the next log of this length differ by sqrt(2) times as much as the halves do; each of the two logs has half of that
variance, the squared difference of its own halves. What a linear drift leaks into other parameters is added, and the
bootstrap draws from torques without it: it would take drift for noise in every direction.

Structures. Rival terms of friction are weighted by exp(-t^2 / 2), with t the excess of their held-out squared error
over that of the best, in deviations of that excess from block to block. What each rival would move is one rank of the
covariance: ``sum_k w_k v_k v_k^T``.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from armlab.estimation import BlockSums, block_bootstrap
from armlab.estimation.linear_problem import LinearSolution
from armlab.identify.friction_structure import FOLDS, IDENTIFIED, TERMS, mixing
from armlab.identify.regression import BLOCK, Design

DRIFTS = ("viscous", "coulomb", "offset")
ROUNDS = 30  # of the pooled variance
RIDGE = 1e-6  # of the power of a column, where a half of the log does not identify a drift


def covariance(design: Design, solution: LinearSolution, length: int, seed: int = 0) -> np.ndarray:
    """Return the covariance (p, p) of a solution, gains known; `length` blocks make a segment."""
    drift, steady = _without_drift(design, solution, length)
    drawn = block_bootstrap(BlockSums.of(steady), seed=seed, length=length).cov
    return drawn + drift + _structure_share(design, solution)


def _without_drift(design: Design, solution: LinearSolution, length: int) -> tuple[np.ndarray, LinearSolution]:
    """Return the share of drift (p, p), and the solution with torques from which the linear drift was taken."""
    found = [_drifts(design, solution, length, i) for i in range(len(design.joints))]
    difference, variance = (np.array(part) for part in list(zip(*found))[:2])
    pooled = np.zeros(len(DRIFTS))
    for _ in range(ROUNDS):
        weight = 1.0 / np.maximum(variance + pooled, 1e-300) ** 2
        pooled = np.maximum(np.sum(weight * (difference**2 - variance), axis=0) / weight.sum(axis=0), 0.0)
    likely = difference * pooled / np.maximum(pooled + variance, 1e-300)
    share, factors = np.zeros((len(solution.x),) * 2), []
    for R, columns, change, (_, _, moved, leaked) in zip(
        solution.factors.R, solution.factors.columns, likely, found, strict=True
    ):
        share += (moved * pooled) @ moved.T + (leaked * (4.0 * pooled)) @ leaked.T
        steady = R.copy()
        steady[:, :, -1] -= 2.0 * _time(len(R))[:, None] * (R[:, :, :-1] @ (moved[columns] @ change))
        factors.append(steady)
    return share, replace(solution, factors=replace(solution.factors, R=tuple(factors)))


def _time(blocks: int) -> np.ndarray:
    return (np.arange(blocks) + 0.5) / blocks - 0.5


def _drifts(design: Design, solution: LinearSolution, length: int, i: int) -> tuple[np.ndarray, ...]:
    """Return of one joint the differences (3,) of its halves and their variances, relative to the torque of friction.

    Then (p, 3) the parameters of such a change, and what the solution leaks of a linear drift that has no mean.
    """
    factors, columns, x = solution.factors, solution.factors.columns[i], solution.x
    A, y = factors.R[i][:, :, :-1], factors.R[i][:, :, -1]
    blocks, rows = len(A), max(int(factors.rows[:, i].sum()), 1)
    D, own = _directions(design, x, i)
    size = np.sqrt(np.sum((A @ D) ** 2, axis=(0, 1)) / rows)
    friction = np.sqrt(np.sum((A @ own) ** 2) / rows)
    scale = np.divide(friction, size, out=np.zeros_like(size), where=size > 0)
    U, e, power = A @ (D * scale), y - A @ x[columns], max(rows * friction**2, 1e-300)
    change, variance = np.zeros((2, 2, len(DRIFTS)))
    for half, kept in enumerate(np.array_split(np.arange(blocks), 2)):
        gram = np.einsum("bij,bik->bjk", U[kept], U[kept])
        moment = np.einsum("bij,bi->bj", U[kept], e[kept])
        inverse = np.linalg.inv(gram.sum(axis=0) + RIDGE * power * np.eye(len(DRIFTS)))
        change[half] = inverse @ moment.sum(axis=0)
        left = moment - gram @ change[half]
        left = np.add.reduceat(left, np.arange(0, len(left), length), axis=0)
        freedom = len(left) / max(len(left) - len(DRIFTS), 1)
        variance[half] = np.sum((left @ inverse) ** 2, axis=0) * freedom
    moved, pushed = np.zeros((2, len(x), len(DRIFTS)))
    moved[columns] = D * scale
    pushed[columns] = solution.weights[i] ** 2 * np.einsum("b,bij,bik->jk", _time(blocks), A, U)
    return change[1] - change[0], variance.sum(axis=0), moved, solution.basis @ (solution.basis.T @ pushed)


def _directions(design: Design, x: np.ndarray, i: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the changes (w, 3) of a joint's parameters by one unit of each drift, and those of friction (w,) alone.

    Coulomb friction of both directions changes in proportion.
    """
    terms, width = design.terms[i], design.rigid[i].shape[1]
    columns = design.layout.columns[i]
    kinds = [term.rstrip("+-") for term in terms]
    D, own = np.zeros((len(columns), len(DRIFTS))), np.zeros(len(columns))
    for k, kind in enumerate(kinds):
        if kind in DRIFTS:
            own[width + k] = x[columns[width + k]]
            D[width + k, DRIFTS.index(kind)] = 1.0
    both = D[:, 1] > 0
    if np.all(own[both] > 0):
        D[both, 1] = own[both] / own[both].mean()
    return D, own


def _structure_share(design: Design, solution: LinearSolution) -> np.ndarray:
    x, M = solution.x, len(design.rows)
    cov, structure = np.zeros((len(x), len(x))), design.moved(x)
    trust = solution.row_weights.reshape(-1, M).T if solution.row_weights.size else np.ones_like(design.tau)
    block = np.arange(M) // max(1, round(BLOCK * design.data.rate / design.decimation.every))
    for i, full in enumerate(design.own_columns(structure)):
        columns, width, count = design.layout.columns[i], design.rigid[i].shape[1], len(design.terms[i])
        others = np.r_[:width, width + count : len(columns)]
        A = np.hstack([design.rigid[i], design.local[i]])
        y, root = design.tau[:, i] - A[:, others] @ x[columns[others]], np.sqrt(trust[:, i, None])
        here = int(np.flatnonzero((structure.terms[i] == TERMS).all(axis=1))[0])
        parameters, weights = _rivals(full * root, y * root[:, 0], block)
        if not weights[here]:
            continue
        own = np.linalg.pinv(mixing(TERMS[here], full.shape[1]))
        for rival in np.flatnonzero(weights):
            apart = parameters[rival] - parameters[here]
            pushed, moved = np.zeros((2, len(x)))
            pushed[columns] = solution.weights[i] ** 2 * (A * trust[:, i, None]).T @ (full @ apart)
            moved[columns[width : width + len(own)]] = own @ apart
            moved -= solution.basis @ (solution.basis.T @ pushed)
            cov += weights[rival] * np.outer(moved, moved)
    return cov


def _rivals(full: np.ndarray, y: np.ndarray, block: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the parameters (K, W) of all columns (M, W) of a joint by each of TERMS, and their weights (K,)."""
    fold, count = block % FOLDS, block[-1] + 1
    parts = [(full[fold == f], y[fold == f]) for f in range(FOLDS)]
    grams, moments = (np.array(part) for part in zip(*((A.T @ A, A.T @ b) for A, b in parts)))
    gram, moment = grams.sum(axis=0), moments.sum(axis=0)
    parameters, errors = np.zeros((len(TERMS), full.shape[1])), np.full((len(TERMS), count), np.inf)
    for k, terms in enumerate(TERMS):
        T = mixing(terms, full.shape[1])
        solved = [_solved(T, gram - G, moment - m) for G, m in zip(grams, moments)]
        whole, alone = _solved(T, gram, moment), [_solved(T, G, m) for G, m in zip(grams, moments)]
        if whole is None or any(one is None for one in (*solved, *alone)):
            continue
        parameters[k] = whole
        left = np.einsum("mw,mw->m", full, np.array(solved)[fold])
        errors[k] = np.bincount(block, weights=(y - left) ** 2, minlength=count)
    total = errors.sum(axis=1)
    excess = np.where(np.isfinite(errors), errors - errors[np.argmin(total)], 0.0)
    deviation = np.std(excess, axis=1, ddof=1) * np.sqrt(count)
    t = np.divide(excess.sum(axis=1), deviation, out=np.zeros(len(TERMS)), where=deviation > 0)
    weights = np.where(np.isfinite(total), np.exp(-0.5 * t * t), 0.0)
    return parameters, weights / max(weights.sum(), 1e-300)


def _solved(T: np.ndarray, gram: np.ndarray, moment: np.ndarray) -> np.ndarray | None:
    """Return the parameters (W,) of the columns that T picks; None where the rows do not identify them."""
    G = T.T @ gram @ T
    scale = np.sqrt(np.diag(G))
    if not scale.all():
        return None
    G = G / np.outer(scale, scale)
    if np.linalg.eigvalsh(G)[0] < IDENTIFIED:
        return None
    return T @ (np.linalg.solve(G, T.T @ moment / scale) / scale)
