"""Rotations SO(3) as arrays (..., 3, 3) and their vectors w (..., 3) [rad]."""

from __future__ import annotations

import numpy as np

__all__ = ["ROTATION_TOLERANCE", "is_rotation"]

ROTATION_TOLERANCE = 1e-9
"""Largest entry of |RᵀR - I| that passes for a rotation."""


def is_rotation(R: np.ndarray, tolerance: float = ROTATION_TOLERANCE) -> np.ndarray:
    """Tell which matrices are rotations: ``RᵀR = I`` and ``det R > 0``.

    Parameters
    ----------
    R : (..., 3, 3).
    tolerance : largest entry of ``|RᵀR - I|``.

    Returns
    -------
    (...) bool; False for NaN.
    """
    R = np.asarray(R, dtype=np.float64)
    with np.errstate(invalid="ignore"):
        error = np.abs(np.swapaxes(R, -1, -2) @ R - np.eye(3)).max(axis=(-1, -2))
        return (error <= tolerance) & (np.linalg.det(R) > 0)
