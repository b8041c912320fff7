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
        self._kernel, self._gains, self._sd = kernel, gains, np.sqrt(variance)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._kernel, name)

    def step(self, q: np.ndarray, qd: np.ndarray, tau: np.ndarray, dt: float) -> Any:
        """Take one sample: q, qd, tau (n,), dt [s]."""
        found = self._kernel.step(q, qd, self._true(tau), dt)
        spread = self._sd * found[0]
        cov = found[1]
        cov += spread[:, None] * spread  # the kernel's array is nobody else's
        return found

    def run(self, q: np.ndarray, qd: np.ndarray, tau: np.ndarray, dt: np.ndarray) -> Any:
        """Take samples in their order: q, qd, tau (N, n), dt (N,) [s]; the same as steps."""
        found = self._kernel.run(q, qd, self._true(tau), dt)
        spread = self._sd * found[0]
        cov = found[1]
        cov += spread[:, :, None] * spread[:, None, :]
        return found

    def _true(self, tau: np.ndarray) -> np.ndarray:
        tau = np.asarray(tau)
        return tau / self._gains if tau.shape[-1:] == self._gains.shape else tau  # the kernel says what is wrong
