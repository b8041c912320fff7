"""What a cloud of points tells of itself: centroid, principal directions, the size of its rounding."""

from __future__ import annotations

import numpy as np

__all__ = ["principal", "rounding"]


def rounding(p: np.ndarray) -> float:
    """Return the size of rounding in points (N, 3): no deviation is known to be smaller."""
    return 1e-14 * max(float(np.abs(p).max(initial=0.0)), 1e-300)


def principal(p: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return centroid, principal directions (3, 3) as rows, strongest first, and sums of squares (3,) along them.

    Their signs are chosen, not left to the decomposition: the largest component is positive.
    """
    c = p.mean(axis=0)
    R = np.linalg.qr(p - c, mode="r")  # a million points have the directions of three
    _, singular, axes = np.linalg.svd(np.vstack([R, np.zeros((3 - len(R), 3))]))
    return c, axes * np.where(axes[np.arange(3), np.abs(axes).argmax(axis=1)] < 0, -1.0, 1.0)[:, None], singular**2
