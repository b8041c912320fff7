"""Least squares by an orthogonal factor of the column-scaled matrix; the normal matrix is never formed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["Solution", "solve"]

RCOND = 1e-11  # relative singular value below which a direction is left at zero


@dataclass(frozen=True)
class Solution:
    """Solution x (p, q) of ``A x = b``, the inverse G (p, p) of the normal matrix, and the triangle (p, p) of A."""

    x: np.ndarray
    G: np.ndarray
    triangle: np.ndarray


def solve(A: np.ndarray, b: np.ndarray, ridge: np.ndarray | None = None, rows: np.ndarray | None = None) -> Solution:
    """Minimise ``||rows A x - b||^2 + sum ridge x^2``.

    Parameters
    ----------
    A : (N, p). b : (N, q). ridge : (p,) penalties of the unknowns. rows : (N,) factors of the rows of A.
    """
    from scipy.linalg import get_lapack_funcs, solve_triangular

    p, q = A.shape[1], b.shape[1]
    N, extra = len(A), 0 if ridge is None else p
    joined = np.empty((max(N, p) + extra, p + q), order="F")
    np.multiply(A, 1.0 if rows is None else rows[:, None], out=joined[:N, :p])
    joined[:N, p:] = b
    joined[N:] = 0.0
    if ridge is not None:
        joined[-p:, :p] = np.diag(np.sqrt(ridge))
    geqrf, trcon = get_lapack_funcs(("geqrf", "trcon"), (joined,))
    factor = geqrf(joined, overwrite_a=True)[0]
    R, rotated = np.triu(factor[:p, :p]), factor[:p, p:]
    norms = np.sqrt((R**2).sum(axis=0))  # of the columns of A; a reflection scales with its column
    scale = np.where(norms > 0, norms, 1.0)
    R /= scale
    if trcon(R)[0] > RCOND:
        inverse = solve_triangular(R, np.eye(p))
        x = solve_triangular(R, rotated)
    else:
        U, s, V = np.linalg.svd(R)
        told = s > RCOND * s[0]
        inverse = V.T * np.where(told, 1.0 / np.where(told, s, 1.0), 0.0)
        x = inverse @ (U.T @ rotated)
    inverse = inverse / scale[:, None]
    return Solution(x / scale[:, None], inverse @ inverse.T, R * scale)
