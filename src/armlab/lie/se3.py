"""Poses SE(3) as arrays (..., 4, 4) and their twists [v; w] (..., 6)."""

from __future__ import annotations

import numpy as np

from armlab.lie import so3

__all__ = ["is_pose"]


def is_pose(T: np.ndarray, tolerance: float = so3.ROTATION_TOLERANCE) -> np.ndarray:
    """Tell which matrices are poses: a rotation, a finite position and the last row (0, 0, 0, 1).

    Parameters
    ----------
    T : (..., 4, 4).
    tolerance : largest entry of ``|RᵀR - I|``.

    Returns
    -------
    (...) bool; False for NaN.
    """
    T = np.asarray(T, dtype=np.float64)
    last_row = (T[..., 3, :] == (0.0, 0.0, 0.0, 1.0)).all(axis=-1)
    return so3.is_rotation(T[..., :3, :3], tolerance) & np.isfinite(T[..., :3, 3]).all(axis=-1) & last_row
