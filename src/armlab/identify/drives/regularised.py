"""Group lasso, solved by an accelerated proximal gradient method with restart until the duality gap is small.

    min_x  1/2 |y - A x|^2 + penalty sqrt(size) sum_g |x_g|

over groups of `size` neighbouring columns. The coefficients of a group are either all zero or all free.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from armlab.errors import NotConverged
from armlab.estimation.robust import shrinkage

# Ridge regression on coloured residuals: coefficients, a covariance without a noise model, held-out errors.
#
#     x = H^-1 A^T y,    H = A^T A + r 1,    cov = H^-1 (S + r^2 v 1) H^-1
#
# with S the scatter of the moments of segments.


RIDGE = 1e-6  # ridge relative to the mean diagonal
FOLDS = 5
MOST_STRETCHES = 200  # maximum number of segments needed to estimate a covariance
FULL = 1e-6  # lower limit on the share of a direction determined by the other segments


def ridge_solution(A: np.ndarray, y: np.ndarray, ridge: float = RIDGE) -> tuple[np.ndarray, np.ndarray]:
    """Return ridge coefficients (p,) and their normal matrix (p, p); see `refit`."""
    H = A.T @ A
    H[np.diag_indices_from(H)] += ridge * np.trace(H) / max(len(H), 1)
    return np.linalg.solve(H, A.T @ y), H


def refit(
    A: np.ndarray, y: np.ndarray, block: np.ndarray, ridge: float = RIDGE, beside: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return ridge coefficients (p,) and their covariance (p, p) from the scatter of blocks.

    ``H = A^T A + r 1, r = ridge mean(diag)``, ``cov = H^-1 (S + r^2 v 1) H^-1`` with S the scatter ``sum_b g_b g_b^T``
    of the moments g_b of the residuals per block. `cov` exceeds the formal covariance if residuals are correlated.
    With few blocks, S would be rank-deficient and is shrunk towards a multiple of H (`shrinkage`). The mean square v of
    the coefficients accounts for the ridge bias of weakly determined coefficients.
    """
    x, H = ridge_solution(A, y, ridge)
    pull = ridge * np.trace(H) / max(len(H), 1) / (1.0 + ridge)
    left, size = y - A @ x, len(x)
    if beside is not None:
        A = np.hstack([A, beside])
        H = np.block([[H, A[:, :size].T @ beside], [beside.T @ A[:, :size], beside.T @ beside]])
    pulled = np.linalg.inv(H)[:, :size] * pull * np.sqrt(np.mean(x**2))
    return x, scattered(H, _moments(A, left, H, block)) + pulled @ pulled.T


def _moments(A: np.ndarray, left: np.ndarray, H: np.ndarray, block: np.ndarray) -> np.ndarray:
    """Return the moments (B, p) of segments, scaled so that their variance matches that of the noise.

    If a single segment determines a coefficient, the residual contains none of the noise of that segment. If the
    segment contributes the share M of H, its moment is therefore ``(1 - M)^(-1/2)`` times the moment of the residuals,
    in coordinates with H = 1 (Bell and McCaffrey 2002).
    """
    number = np.asarray(block) // (1 + int(np.max(block)) // MOST_STRETCHES)
    root = np.linalg.cholesky(H)
    B = np.linalg.solve(root, A.T).T
    whole = np.zeros((int(np.max(number)) + 1, len(H)))
    for k in np.unique(number):
        rows = number == k
        values, vectors = np.linalg.eigh(B[rows].T @ B[rows])
        whole[k] = vectors @ ((vectors.T @ (B[rows].T @ left[rows])) / np.sqrt(np.maximum(1.0 - values, FULL)))
    return whole @ root.T


def scattered(H: np.ndarray, moments: np.ndarray) -> np.ndarray:
    """Return ``H^-1 S H^-1`` (p, p) with S the scatter of the moments, shrunk towards a multiple of H if there are few
    moments.

    `H`: (p, p) normal matrix. `moments`: (B, p) gradients of independent segments, which sum to about 0.
    Sandwich covariance: Huber (1967), The behavior of maximum likelihood estimates under nonstandard conditions.
    """
    scale = np.sqrt(np.diag(H))  # parameters have different units
    root = np.linalg.cholesky(H / np.outer(scale, scale))
    scores = np.linalg.solve(root, (moments / scale).T).T
    chance, S = shrinkage(scores), scores.T @ scores
    S = (1.0 - chance) * S + chance * np.trace(S) / len(S) * np.eye(len(S))
    half = np.linalg.solve(root.T, np.linalg.cholesky(S)) / scale[:, None]
    return half @ half.T


def held_out_error(A: np.ndarray, y: np.ndarray, block: np.ndarray, ridge: float = RIDGE) -> float:
    """Return the mean square of y - A x on held-out blocks."""
    total, fold = 0.0, np.asarray(block) % FOLDS
    for k in range(FOLDS):
        out = fold == k
        x = ridge_solution(A[~out], y[~out], ridge)[0]
        total += float(np.sum((y[out] - A[out] @ x) ** 2))
    return total / len(y)


GAP = 1e-6  # accepted relative duality gap
ROUNDS = 20000
PATH = 20  # number of penalties tried
SHORTEST = 1e-3  # ratio of the smallest penalty to the largest


@dataclass(frozen=True, eq=False)
class GroupLasso:
    """Solution of a group lasso.

    `x`: (p,) coefficients. `gap`: relative duality gap.
    """

    x: np.ndarray
    objective: float
    gap: float
    rounds: int


@dataclass(frozen=True, eq=False)
class LassoSums:
    """Sums A^T A, A^T y and y^T y, which define the problem."""

    gram: np.ndarray
    moment: np.ndarray
    power: float

    @classmethod
    def of(cls, A: np.ndarray, y: np.ndarray) -> LassoSums:
        return cls(A.T @ A, A.T @ y, float(y @ y))

    @cached_property
    def steepness(self) -> float:
        """Largest eigenvalue of A^T A, the Lipschitz constant of the gradient."""
        return float(np.linalg.eigvalsh(self.gram)[-1]) if len(self.gram) else 0.0

    def minus(self, other: LassoSums) -> LassoSums:
        return LassoSums(self.gram - other.gram, self.moment - other.moment, self.power - other.power)

    def error(self, x: np.ndarray) -> float:
        """Return |y - A x|^2."""
        return max(float(self.power - 2 * self.moment @ x + x @ self.gram @ x), 0.0)


def _norms(x: np.ndarray, size: int) -> np.ndarray:
    return np.linalg.norm(x.reshape(-1, size), axis=1)


def group_lasso(sums: LassoSums, size: int, penalty: float, x: np.ndarray) -> GroupLasso:
    """Solve from an initial guess x (p,), by FISTA with adaptive restart, for columns in groups of `size`.

    After Yuan and Lin (2006); Beck and Teboulle (2009); O'Donoghue and Candes (2015), Adaptive restart.
    """
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


def _gap(sums: LassoSums, size: int, threshold: float, x: np.ndarray) -> tuple[float, float]:
    """Return the objective and its relative duality gap; the dual variable is the scaled residual."""
    error = sums.error(x)
    objective = 0.5 * error + threshold * float(_norms(x, size).sum())
    steepest = float(_norms(sums.moment - sums.gram @ x, size).max())
    scale = min(1.0, threshold / steepest) if steepest > 0 else 1.0
    dual = scale * (sums.power - float(sums.moment @ x)) - 0.5 * scale**2 * error
    return objective, (objective - dual) / max(objective, 1e-300)


def select_groups(A: np.ndarray, y: np.ndarray, size: int, block: np.ndarray) -> np.ndarray:
    """Return the mask (G,) of the groups selected by a group lasso.

    The penalty is the largest of 20 candidates whose held-out error is within one standard deviation of the smallest.
    """
    fold = block % FOLDS
    parts = [LassoSums.of(A[fold == k], y[fold == k]) for k in range(FOLDS)]
    whole = LassoSums.of(A, y)
    largest = float(_norms(whole.moment, size).max()) / np.sqrt(size)
    if largest <= 0:
        return np.zeros(A.shape[1] // size, dtype=bool)
    penalties = largest * np.geomspace(1.0, SHORTEST, PATH)
    errors = np.empty((FOLDS, PATH))
    for k, part in enumerate(parts):
        rest, x, count = whole.minus(part), np.zeros(A.shape[1]), np.count_nonzero(fold == k)
        for j, penalty in enumerate(penalties):
            x = group_lasso(rest, size, penalty * (1.0 - count / len(y)), x).x
            errors[k, j] = part.error(x) / count
    mean, best = errors.mean(axis=0), int(np.argmin(errors.mean(axis=0)))
    chosen = int(np.flatnonzero(mean <= mean[best] + errors[:, best].std(ddof=1))[0])
    x = np.zeros(A.shape[1])
    for penalty in penalties[: chosen + 1]:
        x = group_lasso(whole, size, penalty, x).x
    return _norms(x, size) > 0
