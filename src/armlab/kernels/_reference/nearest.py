"""The rotation nearest to a matrix, in NumPy."""

from __future__ import annotations

from typing import Any

import numpy as np

from armlab.kernels._reference.arrays import elements, result
from armlab.kernels._reference.lie import so3_exp

__all__ = ["so3_nearest"]


def so3_nearest(M: Any, out: Any = None) -> tuple[np.ndarray, np.ndarray]:
    """``U diag(1, 1, d) Vᵀ`` of ``M = U S Vᵀ``, d = det UVᵀ, and (..., 3) ``σ₁, σ₂, d σ₃``.

    ``σ₂ + d σ₃`` says how well the rotation is determined; where it is 0 the rotation is one of many. Where an entry of
    M is not finite everything is NaN.
    """
    M = given = elements(M, "M", (3, 3))
    missing = ~np.isfinite(M).all(axis=(-1, -2), keepdims=True)
    M = np.where(missing, np.eye(3), M)
    U, S, Vt = np.linalg.svd(M)
    sign = np.sign(np.linalg.det(U @ Vt))
    U[..., 2] *= sign[..., None]
    S[..., 2] *= sign
    determined = S[..., 1:].sum(axis=-1) > 1e-9 * S[..., 0]
    R = np.where(determined[..., None, None], _refine(U @ Vt, M, determined), U @ Vt)
    return result(np.where(missing, np.nan, R), out, M=given), np.where(missing[..., 0], np.nan, S)


def _refine(R: np.ndarray, M: np.ndarray, determined: np.ndarray) -> np.ndarray:
    """R after Newton steps towards the nearest orthonormal matrix and the rotation nearest to M.

    They remove the rounding of the singular value decomposition. With ``A = Rᵀ M`` and its symmetric part S:
    ``R exp(w)``, ``(tr S I - S) w = vee(A - Aᵀ)``.
    """
    R = R @ (1.5 * np.eye(3) - 0.5 * np.swapaxes(R, -1, -2) @ R)
    A = np.swapaxes(R, -1, -2) @ M
    S = (A + np.swapaxes(A, -1, -2)) / 2
    H = np.trace(S, axis1=-2, axis2=-1)[..., None, None] * np.eye(3) - S
    a = np.stack([A[..., i, j] - A[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0))], axis=-1)
    w = np.linalg.solve(np.where(determined[..., None, None], H, np.eye(3)), a[..., None])[..., 0]
    return R @ so3_exp(w)
