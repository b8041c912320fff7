"""Least squares with one unknown gain per joint: ``y_i = (1 + g_i) A_i x + e_i``, ``g_i ~ N(0, s^2)``.

The problem is kept as sums per joint and block of time. Newton's method without second derivatives (Gauss-Newton); the
gains, each in its own equation, are eliminated:

    (H - sum_i u_i u_i^T / d_i) dx = -(r - sum_i u_i e_i / d_i),   dg_i = -(e_i + u_i dx) / d_i
    H = sum k^2 G_i,   u_i = k G_i x,   d_i = x^T G_i x + 1 / s^2,   k = 1 + g_i

The covariance of x is the scatter of the blocks' gradients (the bootstrap of whole blocks, of many draws) and what the
gains may be. Chance in the scatter of few blocks is shrunk away as in `estimation.block_bootstrap`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armlab.estimation import LinearSolution, effective_samples, shrinkage

__all__ = ["GainProblem"]

STEPS, SETTLED = 30, 1e-9
EXACT = 1e-5  # residuals below this share of the measurements are rounding, not knowledge of the gain


@dataclass(frozen=True, eq=False)
class GainProblem:
    """Sums of a regression with unknown gains.

    Attributes
    ----------
    sums : (B, n, p + 1, p + 1) of ``[A y]^T [A y]`` per block and joint, weighted by 1 / variance, each joint by the
        share of its samples that are independent.
    weights : (n,) what a squared residual of each joint counts [1 / (N m)^2].
    gain_sd : s, 0 where the gains are known to be 1.
    stretch : how much further a robust solution moves than its weighted sums say.
    """

    sums: np.ndarray
    weights: np.ndarray
    gain_sd: float
    stretch: float = 1.0

    @classmethod
    def of(cls, solution: LinearSolution, residuals: np.ndarray, gains: np.ndarray, gain_sd: float) -> GainProblem:
        """Build the sums from a solution of rows ``(1 + gains_i) A_i``.

        Parameters
        ----------
        solution : its classes are the joints; its weights of rows and joints are used.
        residuals : (M, n) of it, evenly sampled. gains : (n,) a first guess of the gains less 1. gain_sd : s.
        """
        factors, p = solution.factors, len(solution.x)
        share = np.array([effective_samples(column) for column in residuals.T]) / len(residuals)
        size = np.array([np.linalg.norm(R[:, :, -1]) for R in factors.R]) / np.sqrt(len(residuals))
        weights = share / np.maximum(1.0 / solution.weights, EXACT * size) ** 2
        sums = np.zeros((len(factors.rows), len(weights), p + 1, p + 1))
        for i, (R, columns) in enumerate(zip(factors.R, factors.columns)):
            at = np.append(columns, p)
            R = R / np.append(np.full(len(columns), 1.0 + gains[i]), 1.0)
            sums[:, i, at[:, None], at] = weights[i] * R.transpose(0, 2, 1) @ R
        return cls(sums, weights, gain_sd, solution.stretch)

    def solve(self) -> tuple[np.ndarray, np.ndarray]:
        """Return x (p,) and the gains less 1 (n,)."""
        p = self.sums.shape[-1] - 1
        total = self.sums.sum(axis=0)
        scale = np.sqrt(np.einsum("iaa->a", total[:, :p, :p]))
        scale = np.where(scale > 0, scale, 1.0)
        G, b = total[:, :p, :p] / np.outer(scale, scale), total[:, :p, p] / scale
        x, g = np.linalg.solve(G.sum(axis=0), b.sum(axis=0)), np.zeros(len(b))
        for _ in range(STEPS):
            S, u, d = self._normal(G, x, 1.0 + g)
            short = u - b  # k G x - b
            e = short @ x + (g / self.gain_sd**2 if self.gain_sd else 0.0)
            dx = -np.linalg.solve(S, (1.0 + g) @ short - (e / d) @ u)
            g = g - (e + u @ dx) / d
            x = x + dx
            if np.abs(dx).max() <= SETTLED * np.abs(x).max():
                break
        return x / scale, g

    def information(self, x: np.ndarray, g: np.ndarray) -> np.ndarray:
        """Return the information (p, p) on x, unknown gains accounted for.

        Parameters
        ----------
        x : (p,) solution. g : (n,) its gains less 1.
        """
        return self._normal(self.sums.sum(axis=0)[:, :-1, :-1], x, 1.0 + g)[0]

    def gain_covariance(self, x: np.ndarray, g: np.ndarray) -> np.ndarray:
        """Return the covariance (n, n) of the gains, x unknown.

        Parameters
        ----------
        x : (p,) solution. g : (n,) its gains less 1.
        """
        G, k = self.sums.sum(axis=0)[:, :-1, :-1], 1.0 + g
        _, u, d = self._normal(G, x, k)
        H = np.tensordot(k * k, G, 1)
        scale = np.sqrt(np.where(np.diag(H) > 0, np.diag(H), 1.0))
        told = np.linalg.solve(H / np.outer(scale, scale), (u / scale).T)
        cov = np.linalg.inv(np.diag(d) - (u / scale) @ told)
        return 0.5 * (cov + cov.T)

    def response(self, x: np.ndarray, g: np.ndarray) -> np.ndarray:
        """Return how x follows the sums ``weights_i A_i^T e_i`` of each joint (n, p, p): dx = sum_i response_i @ them.

        Parameters
        ----------
        x : (p,) solution. g : (n,) its gains less 1.
        """
        S, through, _ = self._reduced(x, g)
        return np.linalg.solve(S, through)

    def covariance(self, x: np.ndarray, g: np.ndarray) -> np.ndarray:
        """Return the covariance (p, p) of x: scatter of the blocks, and gains.

        Parameters
        ----------
        x : (p,) solution. g : (n,) its gains less 1.
        """
        S, through, pushes = self._reduced(x, g)
        B, A = len(self.sums), self.sums[:, :, :-1, :-1]
        left = self.sums[:, :, :-1, -1] - (1.0 + g)[:, None] * (A @ x)  # A^T e of blocks and joints
        gradients = np.einsum("iab,jib->ja", through, left)
        white = np.einsum("iab,ibc,idc->ad", through, A.sum(axis=0), through)  # their covariance if e were white
        root = np.linalg.cholesky(white)
        scores = np.linalg.solve(root, (gradients - gradients.mean(axis=0)).T).T
        chance = shrinkage(scores)
        scatter = self.stretch**2 * B / (B - 1.0) * scores.T @ scores
        scatter = (1.0 - chance) * scatter + chance * np.trace(scatter) / len(x) * np.eye(len(x))
        sides = np.linalg.solve(S, np.hstack([root @ np.linalg.cholesky(scatter), pushes]))
        return sides @ sides.T

    def _reduced(self, x: np.ndarray, g: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the information (p, p), what passes to x of each joint's sums (n, p, p), and of its gain (p, n)."""
        k = 1.0 + g
        S, u, d = self._normal(self.sums.sum(axis=0)[:, :-1, :-1], x, k)
        through = k[:, None, None] * np.eye(len(x)) - u[:, :, None] * x / d[:, None, None]
        return S, through, (u / d[:, None]).T / self.gain_sd if self.gain_sd else np.zeros((len(x), 0))

    def _normal(self, G: np.ndarray, x: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the information on x (p, p), u (n, p) and d (n,) of the module."""
        Gx = G @ x
        u = k[:, None] * Gx
        d = Gx @ x + (1.0 / self.gain_sd**2 if self.gain_sd else np.inf)
        return np.tensordot(k * k, G, 1) - (u / d[:, None]).T @ u, u, d
