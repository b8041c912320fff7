"""Least squares with one unknown gain per joint: ``y_i = (1 + g_i) A_i x + e_i``, ``g_i ~ N(c_i, s^2)``.

The problem is kept as sums per joint and block of time, so that drawing blocks again costs a few small solves. Newton's
method without second derivatives (Gauss-Newton); the gains, each in its own equation, are eliminated:

    (H - sum_i u_i u_i^T / d_i) dx = -(r - sum_i u_i e_i / d_i),   dg_i = -(e_i + u_i dx) / d_i
    H = sum k^2 G_i,   u_i = k G_i x,   d_i = x^T G_i x + 1 / s^2,   k = 1 + g_i
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armlab.estimation import LinearSolution, effective_samples

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
    gain_sd : s, 0 where the gains are known to be 1.
    weights : (n,) what a squared residual of each joint counts [1 / (N m)^2].
    """

    sums: np.ndarray
    gain_sd: float
    weights: np.ndarray

    @classmethod
    def of(cls, solution: LinearSolution, residuals: np.ndarray, gain_sd: float) -> GainProblem:
        """Build the sums from a solution without gains.

        Parameters
        ----------
        solution : its classes are the joints; its weights of rows and joints are used.
        residuals : (M, n) of it, evenly sampled. gain_sd : s.
        """
        factors, p = solution.factors, len(solution.x)
        share = np.array([effective_samples(column) for column in residuals.T]) / len(residuals)
        size = np.array([np.linalg.norm(R[:, :, -1]) for R in factors.R]) / np.sqrt(len(residuals))
        sd = np.maximum(1.0 / solution.weights, EXACT * size)
        weights = share / sd**2
        sums = np.zeros((len(factors.rows), len(weights), p + 1, p + 1))
        for i, (R, columns) in enumerate(zip(factors.R, factors.columns)):
            at = np.append(columns, p)
            sums[:, i, at[:, None], at] = weights[i] * R.transpose(0, 2, 1) @ R
        return cls(sums, gain_sd, weights)

    def solve(self, blocks: np.ndarray, centres: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return x (D, p) and gains less 1 (D, n) for D draws.

        Parameters
        ----------
        blocks : (D, B) how often each block counts. centres : (D, n) what the prior expects of the gains less 1.
        """
        p = self.sums.shape[-1] - 1
        sums = np.tensordot(blocks, self.sums, 1)
        scale = np.sqrt(np.einsum("iaa->a", self.sums.sum(axis=0)[:, :p, :p]))
        scale = np.where(scale > 0, scale, 1.0)
        G, b = sums[:, :, :p, :p] / np.outer(scale, scale), sums[:, :, :p, p] / scale
        x = np.linalg.solve(G.sum(axis=1), b.sum(axis=1)[:, :, None])[:, :, 0]
        g = centres.copy() if self.gain_sd else np.zeros_like(centres)
        for _ in range(STEPS):
            k = 1.0 + g
            H, u, d = self._normal(G, x, k)
            short = u - b  # k G x - b
            e = np.einsum("dia,da->di", short, x)
            if self.gain_sd:
                e = e + (g - centres) / self.gain_sd**2
            r = np.einsum("di,dia->da", k, short) - np.einsum("dia,di->da", u, e / d)
            S = self._reduced(H, u, d)
            dx = -np.linalg.solve(S, r[:, :, None])[:, :, 0]
            g = g - (e + np.einsum("dia,da->di", u, dx)) / d
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
        return self._reduced(*self._normal(self.sums.sum(axis=0)[None, :, :-1, :-1], x[None], 1.0 + g[None]))[0]

    def response(self, x: np.ndarray, g: np.ndarray) -> np.ndarray:
        """Return how x follows the sums ``weights_i A_i^T e_i`` of each joint (n, p, p): dx = sum_i response_i @ them.

        Parameters
        ----------
        x : (p,) solution. g : (n,) its gains less 1.
        """
        k = 1.0 + g
        H, u, d = self._normal(self.sums.sum(axis=0)[None, :, :-1, :-1], x[None], k[None])
        through = k[:, None, None] * np.eye(len(x)) - u[0][:, :, None] * x / d[0][:, None, None]
        return np.linalg.solve(self._reduced(H, u, d)[0], through)

    def _normal(self, G: np.ndarray, x: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        H = np.einsum("di,diab->dab", k * k, G)
        Gx = np.einsum("diab,db->dia", G, x)
        d = np.einsum("dia,da->di", Gx, x) + (1.0 / self.gain_sd**2 if self.gain_sd else np.inf)
        return H, k[:, :, None] * Gx, d

    @staticmethod
    def _reduced(H: np.ndarray, u: np.ndarray, d: np.ndarray) -> np.ndarray:
        return H - np.einsum("dia,dib->dab", u / d[:, :, None], u)
