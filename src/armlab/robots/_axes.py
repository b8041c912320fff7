"""Frames whose z axis is a given direction."""

from __future__ import annotations

import numpy as np

__all__ = ["frames_along"]


def frames_along(z: np.ndarray) -> np.ndarray:
    """Return rotations whose third column is z; of a coordinate axis without any rounding, and 1 for z = (0, 0, 1).

    Parameters
    ----------
    z : (n, 3) directions; the length does not matter.

    Returns
    -------
    (n, 3, 3).
    """
    z = z / np.linalg.norm(z, axis=1, keepdims=True)
    x = np.eye(3)[np.argmin(np.abs(z), axis=1)]
    x = x - (x * z).sum(axis=1, keepdims=True) * z
    x = x / np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=-1)
