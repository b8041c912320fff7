"""Group lasso by an accelerated proximal gradient method with restart, stopped by its duality gap.

    min_x  1/2 |y - A x|^2 + penalty sqrt(size) sum_g |x_g|

over groups of `size` neighbouring columns: whole groups are zero or not.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from armlab._numbers import number, numbers
from armlab.errors import NotConverged, ShapeError

__all__ = ["GroupLasso", "group_lasso", "select_groups"]

GAP = 1e-6  # relative
ROUNDS = 20000
PATH = 20  # penalties
SHORTEST = 1e-3  # of the largest penalty


@dataclass(frozen=True, eq=False)
class GroupLasso:
    """A solution.

    Attributes
    ----------
    x : (p,) coefficients. objective : of the problem. gap : objective minus a lower bound of the least, relative to it.
    rounds : of the iteration.
    """

    x: np.ndarray
    objective: float
    gap: float
    rounds: int


@dataclass(frozen=True, eq=False)
class _Sums:
    """A^T A, A^T y and y^T y: all that the problem needs."""

    gram: np.ndarray
    moment: np.ndarray
    power: float

    @classmethod
    def of(cls, A: np.ndarray, y: np.ndarray) -> _Sums:
        return cls(A.T @ A, A.T @ y, float(y @ y))

    @cached_property
    def steepness(self) -> float:
        """Largest eigenvalue of A^T A: no gradient changes faster."""
        return float(np.linalg.eigvalsh(self.gram)[-1]) if len(self.gram) else 0.0

    def minus(self, other: _Sums) -> _Sums:
        return _Sums(self.gram - other.gram, self.moment - other.moment, self.power - other.power)

    def error(self, x: np.ndarray) -> float:
        """Return |y - A x|^2."""
        return max(float(self.power - 2 * self.moment @ x + x @ self.gram @ x), 0.0)


def group_lasso(A: np.ndarray, y: np.ndarray, size: int, penalty: float) -> GroupLasso:
    """Solve the group lasso by FISTA with adaptive restart.

    Parameters
    ----------
    A : (N, p) columns, group by group. y : (N,). size : columns in a group. penalty : above 0.

    Raises
    ------
    ShapeError : other shapes, NaN, a penalty that is not positive. NotConverged : the gap stays above 1e-6.

    References
    ----------
    Yuan and Lin (2006); Beck and Teboulle (2009); O'Donoghue and Candes (2015), Adaptive restart.
    """
    A, y, penalty = numbers(A, "A", ShapeError), numbers(y, "y", ShapeError), number(penalty, "penalty")
    if A.ndim != 2 or y.shape != A.shape[:1] or size < 1 or A.shape[1] % size or not penalty > 0:
        raise ShapeError(
            f"Expected A (N, p), y (N,), groups of equal size and a penalty above 0, got {A.shape}, {y.shape}, "
            f"{size} and {penalty!r}."
        )
    if not np.isfinite(A).all() or not np.isfinite(y).all():
        raise ShapeError("Expected finite A and y, got NaN or Inf. Drop those rows first.")
    return _solve(_Sums.of(A, y), size, penalty, np.zeros(A.shape[1]))


def _norms(x: np.ndarray, size: int) -> np.ndarray:
    return np.linalg.norm(x.reshape(-1, size), axis=1)


def _solve(sums: _Sums, size: int, penalty: float, x: np.ndarray) -> GroupLasso:
    """Solve from a first guess."""
    threshold = penalty * np.sqrt(size)
    L = sums.steepness
    if L <= 0.0:
        return GroupLasso(x, 0.5 * sums.power, 0.0, 0)
    v, momentum, gap, best = x, 1.0, np.inf, 0.0
    for k in range(ROUNDS):
        step = v - (sums.gram @ v - sums.moment) / L
        norms = _norms(step, size)
        shrink = np.maximum(1.0 - threshold / L / np.where(norms > 0, norms, np.inf), 0.0)
        new = (step.reshape(-1, size) * shrink[:, None]).ravel()
        if (v - new) @ (new - x) > 0:  # the momentum points uphill
            momentum = 1.0
        following = 0.5 * (1.0 + np.sqrt(1.0 + 4.0 * momentum**2))
        v = new + (momentum - 1.0) / following * (new - x)
        x, momentum = new, following
        if k % 10 == 9:
            best, gap = _gap(sums, size, threshold, x)
            if gap <= GAP:
                return GroupLasso(x, best, gap, k + 1)
    raise NotConverged(f"Expected a group lasso with a relative gap of {GAP:g}, got {gap:.2g} after {ROUNDS} rounds.")


def _gap(sums: _Sums, size: int, threshold: float, x: np.ndarray) -> tuple[float, float]:
    """Return the objective and its relative distance from the dual one of the scaled residual."""
    error = sums.error(x)
    objective = 0.5 * error + threshold * float(_norms(x, size).sum())
    steepest = float(_norms(sums.moment - sums.gram @ x, size).max())
    scale = min(1.0, threshold / steepest) if steepest > 0 else 1.0
    dual = scale * (sums.power - float(sums.moment @ x)) - 0.5 * scale**2 * error
    return objective, (objective - dual) / max(objective, 1e-300)


def select_groups(A: np.ndarray, y: np.ndarray, size: int, block: np.ndarray, folds: int = 5) -> np.ndarray:
    """Return which groups (G,) a group lasso keeps.

    The penalty is the largest of 20 whose held-out error is within one standard deviation of the least.

    Parameters
    ----------
    A : (N, p) columns, group by group. y : (N,). size : columns in a group.
    block : (N,) block number of each row; whole blocks are held out.
    folds : of the cross-validation.
    """
    A, y, block = (numbers(one, "columns, values and blocks", ShapeError) for one in (A, y, block))
    if A.ndim != 2 or not y.shape == block.shape == A.shape[:1]:
        raise ShapeError(f"Expected columns (N, p), values and blocks (N,), got {A.shape}, {y.shape}, {block.shape}.")
    fold = block % folds
    parts = [_Sums.of(A[fold == k], y[fold == k]) for k in range(folds)]
    whole = _Sums.of(A, y)
    largest = float(_norms(whole.moment, size).max()) / np.sqrt(size)
    if largest <= 0:
        return np.zeros(A.shape[1] // size, dtype=bool)
    penalties = largest * np.geomspace(1.0, SHORTEST, PATH)
    errors = np.empty((folds, PATH))
    for k, part in enumerate(parts):
        rest, x, count = whole.minus(part), np.zeros(A.shape[1]), np.count_nonzero(fold == k)
        for j, penalty in enumerate(penalties):
            x = _solve(rest, size, penalty * (1.0 - count / len(y)), x).x
            errors[k, j] = part.error(x) / count
    mean, best = errors.mean(axis=0), int(np.argmin(errors.mean(axis=0)))
    chosen = int(np.flatnonzero(mean <= mean[best] + errors[:, best].std(ddof=1))[0])
    x = np.zeros(A.shape[1])
    for penalty in penalties[: chosen + 1]:
        x = _solve(whole, size, penalty, x).x
    return _norms(x, size) > 0
