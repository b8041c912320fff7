"""The nearest rotation."""

from __future__ import annotations

import numpy as np

from armlab import kernels


def nearest_rotation(M: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return ``U diag(1, 1, d) Vᵀ`` of ``M = U S Vᵀ``, d = det UVᵀ; the singular values; and ``σ₂ + d σ₃``.

    The last says how well the rotation is determined. NaN gives NaN and passes as well determined.
    """
    missing = ~np.isfinite(M).all(axis=(-1, -2), keepdims=True)
    U, S, Vt = np.linalg.svd(np.where(missing, np.eye(3), M))
    sign = np.sign(determinant(U @ Vt))
    U[..., 2] *= sign[..., None]
    return np.where(missing, np.nan, U @ Vt), S, S[..., 1] + sign * S[..., 2]


def refine(R: np.ndarray, M: np.ndarray) -> np.ndarray:
    """Return R after Newton steps towards the nearest orthonormal matrix and the rotation nearest to M.

    They remove the rounding of the singular value decomposition. With ``A = Rᵀ M`` and its symmetric part S:
    ``R exp(w)``, ``(tr S I - S) w = vee(A - Aᵀ)``.
    """
    R = R @ (1.5 * np.eye(3) - 0.5 * np.swapaxes(R, -1, -2) @ R)
    A = np.swapaxes(R, -1, -2) @ M
    S = (A + np.swapaxes(A, -1, -2)) / 2
    H = np.trace(S, axis1=-2, axis2=-1)[..., None, None] * np.eye(3) - S
    a = np.stack([A[..., i, j] - A[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0))], axis=-1)
    missing = np.isnan(a[..., :, None]).any(axis=-2, keepdims=True)
    return R @ kernels.so3_exp(np.linalg.solve(np.where(missing, np.eye(3), H), a[..., None])[..., 0])


def determinant(R: np.ndarray) -> np.ndarray:
    """Return det R (...); NaN for NaN, of which numpy.linalg.det would warn."""
    return (np.cross(R[..., 0, :], R[..., 1, :]) * R[..., 2, :]).sum(axis=-1)
