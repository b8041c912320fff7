"""What a spring makes of a forcing that repeats itself."""

from __future__ import annotations

import numpy as np

__all__ = ["GRID", "transfer"]

GRID = 1024  # phases of one period: harmonics up to 512


def transfer(alpha: float, stiffness: float) -> np.ndarray:
    """Return what the spring makes of a forcing ``exp(i k phi)``, for k from 0 to 512."""
    k = np.arange(GRID // 2 + 1)
    return 1.0 / (stiffness - k**2 + 1j * alpha * k)
