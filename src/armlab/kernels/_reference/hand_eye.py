"""Residuals of A X = Y B and their derivatives, in NumPy."""

from __future__ import annotations

from typing import Any

import numpy as np

from armlab.errors import ShapeError
from armlab.kernels._reference.arrays import elements
from armlab.kernels._reference.lie import so3_left_jacobian_inv, so3_log

__all__ = ["hand_eye_rows"]


def hand_eye_rows(
    R_A: Any, t_A: Any, R_B: Any, t_B: Any, R_X: Any, t_X: Any, R_Y: Any, t_Y: Any
) -> tuple[np.ndarray, np.ndarray]:
    """``r_t = t_B - t_h`` and ``r_R = log(R_hᵀ R_B)`` with ``h = Y⁻¹ A X``, and their derivatives by X and Y.

    Parameters
    ----------
    R_A, R_B : (..., 3, 3). t_A, t_B : (..., 3). R_X, R_Y : (3, 3). t_X, t_Y : (3,).

    Returns
    -------
    r (..., 6); J (..., 6, 12) by the step (v_X, w_X, v_Y, w_Y) of ``(R Exp(w), t + v)``.
    """
    R_A, R_B = elements(R_A, "R_A", (3, 3)), elements(R_B, "R_B", (3, 3))
    t_A, t_B = elements(t_A, "t_A", (3,)), elements(t_B, "t_B", (3,))
    R_X, t_X = _exactly(R_X, "R_X", (3, 3)), _exactly(t_X, "t_X", (3,))
    R_Y, t_Y = _exactly(R_Y, "R_Y", (3, 3)), _exactly(t_Y, "t_Y", (3,))
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


def _exactly(value: Any, name: str, shape: tuple[int, ...]) -> np.ndarray:
    array = np.asarray(value, dtype=float)
    if array.shape != shape:
        raise ShapeError(f"Expected {name} of shape {shape}, got {array.shape}.")
    return array
