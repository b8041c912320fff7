"""Least squares by an orthogonal factor of the column-scaled matrix; the normal matrix is never formed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

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
