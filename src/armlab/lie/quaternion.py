"""Unit quaternions wxyz as arrays (..., 4)."""

from __future__ import annotations

import numpy as np

__all__ = ["to_matrix"]


def to_matrix(quaternion: np.ndarray) -> np.ndarray:
    """Return the rotation of a quaternion; its length does not matter.

    Parameters
    ----------
    quaternion : (..., 4) wxyz.

    Returns
    -------
    (..., 3, 3).
    """
    q = np.asarray(quaternion, dtype=np.float64)
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
