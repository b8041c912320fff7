"""Estimators for torques as they are read: ``tau = gains (true torque)``, with gains known to a few percent.

Where the gains are off by a common share g, so is the force: its covariance grows by ``var(g) F F^T``. The mean of the
variances of the gains stands for var(g): less where they are independent of each other, more for the one known worst.
"""

from __future__ import annotations

from typing import Any

import numpy as np

__all__ = ["CalibratedKernel"]


class CalibratedKernel:
    """A kernel of an estimator that is given torques as they are read.

    Parameters
    ----------
    kernel : with step, run and reset, of true torques. gains : (n,) torque as it is read over true torque.
    variance : of the force, as a share of its square.
    """

    def __init__(self, kernel: Any, gains: np.ndarray, variance: float) -> None:
        self._kernel, self._gains, self._variance = kernel, gains, variance

    def __getattr__(self, name: str) -> Any:
        return getattr(self._kernel, name)

    def step(self, q: np.ndarray, qd: np.ndarray, tau: np.ndarray, dt: float) -> Any:
        """Take one sample: q, qd, tau (n,), dt [s]."""
        return self._widened(self._kernel.step(q, qd, tau / self._gains, dt))

    def run(self, q: np.ndarray, qd: np.ndarray, tau: np.ndarray, dt: np.ndarray) -> Any:
        """Take samples in their order: q, qd, tau (N, n), dt (N,) [s]; the same as steps."""
        return self._widened(self._kernel.run(q, qd, tau / self._gains, dt))

    def _widened(self, found: Any) -> Any:
        F, cov, *rest = found
        return F, cov + self._variance * (F[..., :, None] * F[..., None, :]), *rest
