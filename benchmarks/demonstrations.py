"""Demonstrations shared by the motion benchmarks."""

from __future__ import annotations

import numpy as np

N, JOINTS, KERNELS = 1000, 7, 50


def demonstration(seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Return times (N,) over one second and positions (N, JOINTS), at rest at both ends."""
    u = np.linspace(0.0, 1.0, N)
    rng = np.random.default_rng(seed)
    jerk = 10 * u**3 - 15 * u**4 + 6 * u**5
    bump = 0.1 * np.sin(np.pi * jerk)[:, None] ** 2
    return u, rng.normal(size=JOINTS) + rng.normal(size=JOINTS) * jerk[:, None] + bump


def rmse(path: np.ndarray, wanted: np.ndarray) -> float:
    """Return the root-mean-square difference."""
    return float(np.sqrt(((path - wanted) ** 2).mean()))
