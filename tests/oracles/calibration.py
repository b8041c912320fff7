"""Residuals of A X = Y B; the most likely rotation, mass and bias of a weight that hangs on a sensor."""

from __future__ import annotations

from typing import Any

import numpy as np

from .lie import so3_left_jacobian_inv, so3_log, so3_nearest


def hand_eye_rows(
    R_A: Any, t_A: Any, R_B: Any, t_B: Any, R_X: Any, t_X: Any, R_Y: Any, t_Y: Any
) -> tuple[np.ndarray, np.ndarray]:
    """``r_t = t_B - t_h`` and ``r_R = log(R_hᵀ R_B)`` with ``h = Y⁻¹ A X``, and their derivatives by X and Y."""
    R_A, R_B = np.asarray(R_A, dtype=float), np.asarray(R_B, dtype=float)
    t_A, t_B = np.asarray(t_A, dtype=float), np.asarray(t_B, dtype=float)
    R_X, t_X = np.asarray(R_X, dtype=float), np.asarray(t_X, dtype=float)
    R_Y, t_Y = np.asarray(R_Y, dtype=float), np.asarray(t_Y, dtype=float)
    C = R_Y.T @ R_A
    t = C @ t_X + (t_A - t_Y) @ R_Y
    back = np.swapaxes(C @ R_X, -1, -2)
    w = so3_log(back @ R_B)
    r = np.concatenate(np.broadcast_arrays(t_B - t, w), axis=-1)
    J = np.zeros((*r.shape, 12))
    J[..., :3, :3], J[..., :3, 6:9] = -C, R_Y.T
    J[..., 0, 10], J[..., 1, 11], J[..., 2, 9] = t[..., 2], t[..., 0], t[..., 1]  # -hat(t)
    J[..., 0, 11], J[..., 1, 9], J[..., 2, 10] = -t[..., 1], -t[..., 2], -t[..., 0]
    bent = so3_left_jacobian_inv(w)
    J[..., 3:, 3:6], J[..., 3:, 9:] = -bent, bent @ back
    return r, J


def turned_weight(
    R_base_tool: Any, force: Any, pull: Any, weight: Any = None, mass: float | None = None, biased: bool = True
) -> tuple[np.ndarray, ...]:
    """Minimise ``sum w_i |f_i - m Rᵀ h_i - b|²`` with ``h_i = R_base_tool,iᵀ pull``, in closed form (Umeyama 1991).

    With weighted means taken off where there is a bias, ``S = sum w h fᵀ``, ``H = sum w h hᵀ`` and the singular values
    of `so3_nearest`: R is the rotation nearest to S, ``m = (s1 + s2 + d s3) / tr H``, ``b = mean(f) - m Rᵀ mean(h)``.
    """
    f = np.asarray(force, dtype=float)
    n = f.shape[-2] if f.ndim > 1 else 1
    f, R_BT = np.asarray(f, dtype=float), np.asarray(R_base_tool, dtype=float)
    g = np.asarray(pull, dtype=float)
    w = np.ones(n) if weight is None else np.asarray(weight, dtype=float)
    batch = np.broadcast_shapes(R_BT.shape[:-3], f.shape[:-2], w.shape[:-1])
    f, w = np.broadcast_to(f, (*batch, n, 3)), np.broadcast_to(w, (*batch, n))[..., None]
    h = np.broadcast_to(g @ R_BT, f.shape)
    total = w.sum(axis=-2, keepdims=True)
    h_mean, f_mean = (np.sum(w * part, axis=-2, keepdims=True) / total * biased for part in (h, f))
    h, f = h - h_mean, f - f_mean
    H, S = ((w * h).swapaxes(-1, -2) @ part for part in (h, f))
    R, sigma = so3_nearest(S)
    size = np.trace(H, axis1=-2, axis2=-1)
    sums = sigma @ np.array([[1.0, 1.0], [1.0, 1.0], [1.0, -1.0]])
    m = sums / size[..., None] if mass is None else np.full(sums.shape, float(mass))
    r = f - m[..., :1, None] * (h @ R)
    F = np.sum(w * f * f, axis=(-1, -2))
    other = np.maximum(F - 2.0 * (m * sums)[..., 1] + m[..., 1] ** 2 * size, 0.0)
    power = np.stack([np.sum(w * r * r, axis=(-1, -2)), other, F], axis=-1)
    mean = h_mean @ R
    moved = np.sqrt(np.maximum(np.linalg.eigvalsh(H / total / (g @ g)), 0.0))
    cov = _covariance(R, m[..., 0], H, size, mean[..., 0, :], total[..., 0, 0], mass is None, biased)
    bias = (f_mean - m[..., :1, None] * mean)[..., 0, :]
    return R, bias, r, cov, np.stack([H, S], axis=-3), np.concatenate([m, power, moved], axis=-1)


def _covariance(
    R: np.ndarray, m: np.ndarray, H: np.ndarray, size: np.ndarray, mean: np.ndarray, weights: np.ndarray,
    free_mass: bool, biased: bool,
) -> np.ndarray:  # fmt: skip
    """Return the covariance (..., d, d).

    Centred, rotation, mass and bias do not mix: ``C_x = Rᵀ (m² (tr H - H))⁻¹ R``, ``C_m = 1 / tr H``. Then
    ``b = b_0 - m hat(mean) x - mean m`` with the mean (..., 3) of ``Rᵀ h``.
    """
    free = 3 + free_mass
    cov = np.zeros((*m.shape, free + 3 * biased, free + 3 * biased))
    scale = 1.0 / np.maximum(m * m, np.finfo(float).tiny)
    across = np.linalg.inv(size[..., None, None] * np.eye(3) - H)
    cov[..., :3, :3] = scale[..., None, None] * (R.swapaxes(-1, -2) @ across @ R)
    if free_mass:
        cov[..., 3, 3] = 1.0 / size
    if biased:
        (a, b, c), zero = np.moveaxis(m[..., None] * mean, -1, 0), np.zeros(m.shape)
        A = np.stack([zero, -c, b, c, zero, -a, -b, a, zero], axis=-1).reshape(*m.shape, 3, 3)
        A = np.concatenate([A, mean[..., None]], axis=-1)[..., :free]
        B = -A @ cov[..., :free, :free]
        cov[..., free:, :free], cov[..., :free, free:] = B, B.swapaxes(-1, -2)
        cov[..., free:, free:] = np.eye(3) / weights[..., None, None] - B @ A.swapaxes(-1, -2)
    return cov
