"""Synthetic linear problems shared by several test files."""

from __future__ import annotations

import numpy as np
import pytest

RHO = 0.95


class Problems:
    theta = np.array([1.0, -2.0, 1e3])
    names = ("mass", "offset", "viscous")

    def ar1(self, rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
        """AR(1) records along axis 0 with unit variance."""
        from scipy.signal import lfilter

        noise = rng.standard_normal((shape[0] + 200, shape[1])) * np.sqrt(1 - RHO**2)
        return lfilter([1.0], [1.0, -RHO], noise, axis=0)[200:]

    def draw(self, seed: int, N: int, coloured: bool = False, k: int = 1) -> tuple[np.ndarray, np.ndarray]:
        """Regressor (N, k, 3) and measurements (N, k) with unit noise."""
        rng = np.random.default_rng(seed)
        A = np.stack([self.ar1(rng, (N, 3)) * [1.0, 10.0, 1e-3] for _ in range(k)], axis=1)
        noise = self.ar1(rng, (N, k)) if coloured else rng.standard_normal((N, k))
        return A, A @ self.theta + noise


@pytest.fixture(scope="session")
def problems() -> Problems:
    return Problems()
