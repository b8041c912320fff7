"""Ridge regression on coloured residuals: coefficients, a covariance that takes no model of the noise, held-out errors.

    x = H^-1 A^T y,    H = A^T A + r 1,    cov = H^-1 (S + r^2 v 1) H^-1

with S the scatter of the moments of whole stretches of time.
"""

from __future__ import annotations

import numpy as np

from armlab.estimation import shrinkage

__all__ = ["held_out_error", "refit", "ridge_solution", "scattered"]

RIDGE = 1e-6  # relative
MOST_STRETCHES = 200  # for a covariance
FULL = 1e-6  # least share of a direction that other stretches tell


def ridge_solution(A: np.ndarray, y: np.ndarray, ridge: float = RIDGE) -> tuple[np.ndarray, np.ndarray]:
    """Return ridge coefficients (p,) and the matrix (p, p) of their equations, see `refit`.

    Parameters
    ----------
    A : (N, p). y : (N,). ridge : relative to the mean diagonal of A^T A.
    """
    H = A.T @ A
    H[np.diag_indices_from(H)] += ridge * np.trace(H) / max(len(H), 1)
    return np.linalg.solve(H, A.T @ y), H


def refit(
    A: np.ndarray, y: np.ndarray, block: np.ndarray, ridge: float = RIDGE, beside: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return ridge coefficients (p,) and their covariance (p, p) from the scatter of whole blocks.

    ``H = A^T A + r 1, r = ridge mean(diag)``, ``cov = H^-1 (S + r^2 v 1) H^-1`` with S the scatter ``sum_b g_b g_b^T``
    of the moments g_b of the residuals in a block: residuals that remember make it larger than the formal one. Where
    blocks are few for the coefficients S is shrunk towards a multiple of H (`estimation.shrinkage`): it would have no
    spread in most directions. v is the mean square of the coefficients: so far the ridge pulls what is hardly told.

    Parameters
    ----------
    A : (N, p). y : (N,). block : (N,) numbers. ridge : relative to the mean diagonal of A^T A.
    beside : (N, m) columns of parameters known so far that they leave nothing, free in the covariance, which is then
        (p + m, p + m).
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
    """Return the moments (B, p) of stretches, each as large as that of the noise.

    A stretch that tells a coefficient nearly alone leaves nothing of its own noise: with M its share of H, the moment
    is ``(1 - M)^(-1/2)`` times that of the residuals, in coordinates in which H is 1 (Bell and McCaffrey 2002).
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
    """Return ``H^-1 S H^-1`` (p, p), S the scatter of the moments, shrunk towards a multiple of H where they are few.

    Parameters
    ----------
    H : (p, p) of the normal equations. moments : (B, p) gradients of independent stretches, of sum 0 or nearly so.

    References
    ----------
    Huber (1967), The behavior of maximum likelihood estimates under nonstandard conditions, for the sandwich.
    """
    scale = np.sqrt(np.diag(H))  # parameters of many units
    root = np.linalg.cholesky(H / np.outer(scale, scale))
    scores = np.linalg.solve(root, (moments / scale).T).T
    chance, S = shrinkage(scores), scores.T @ scores
    S = (1.0 - chance) * S + chance * np.trace(S) / len(S) * np.eye(len(S))
    half = np.linalg.solve(root.T, np.linalg.cholesky(S)) / scale[:, None]
    return half @ half.T


def held_out_error(A: np.ndarray, y: np.ndarray, block: np.ndarray, ridge: float = RIDGE, folds: int = 5) -> float:
    """Return the mean square of y - A x on blocks that x was not fitted to.

    Parameters
    ----------
    A : (N, p); without columns the mean square of y. y : (N,). block : (N,) numbers. ridge : relative. folds : number.
    """
    total, fold = 0.0, np.asarray(block) % folds
    for k in range(folds):
        out = fold == k
        x = ridge_solution(A[~out], y[~out], ridge)[0]
        total += float(np.sum((y[out] - A[out] @ x) ** 2))
    return total / len(y)
