"""Least squares over blocks of time: sums that can be left out, drawn again, or added.

A block keeps ``A^T A``, ``A^T y`` and ``y^T y`` of its whitened rows. Residuals of robots are coloured, so the formal
covariance is far too small; drawing whole blocks again (Kunsch 1989) keeps their correlation. Two hundred draws cost
two hundred solves of size d.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armlab.errors import NotExcited, ShapeError

__all__ = ["BlockSums", "accumulate", "block_bootstrap", "correlation_time", "effective_samples"]


@dataclass(frozen=True, eq=False)
class BlockSums:
    """Sums of whitened rows per block of time.

    Attributes
    ----------
    gram : (B, d, d) A^T A. moment : (B, d) A^T y. power : (B,) y^T y. rows : (B,) number of rows.
    """

    gram: np.ndarray
    moment: np.ndarray
    power: np.ndarray
    rows: np.ndarray

    def solve(self, weights: np.ndarray | None = None) -> np.ndarray:
        """Return the least-squares solution (d,) with a weight per block (B,); equal weights when left out.

        Columns are scaled to norm 1 first, so that units do not spoil the precision.

        Raises
        ------
        NotExcited : when the blocks with weight do not determine every parameter.
        """
        w = np.ones(len(self.rows)) if weights is None else np.asarray(weights, dtype=float)
        gram, moment = np.tensordot(w, self.gram, 1), w @ self.moment
        norms = np.sqrt(np.diag(gram))
        try:
            if not np.all(norms > 0):
                raise np.linalg.LinAlgError
            return np.linalg.solve(gram / np.outer(norms, norms), moment / norms) / norms
        except np.linalg.LinAlgError:
            raise NotExcited(
                f"Expected parameters that many blocks of time determine, got one that {np.count_nonzero(w)} of "
                f"{len(w)} blocks do not. Let every joint move for the whole record."
            ) from None


def accumulate(A: np.ndarray, y: np.ndarray, block: np.ndarray) -> BlockSums:
    """Sum whitened rows per block.

    Parameters
    ----------
    A : (N, k, d) whitened regressor of N samples with k rows each.
    y : (N, k) whitened measurements.
    block : (N,) number of the block of each sample, ascending from 0 without holes.
    """
    if A.ndim != 3 or y.shape != A.shape[:2] or block.shape != A.shape[:1]:
        raise ShapeError(
            f"Expected A (N, k, d), y (N, k) and block (N,), got {A.shape}, {y.shape} and {block.shape}. "
            "Give one row of y and one block number per sample."
        )
    edges = np.flatnonzero(np.diff(block, prepend=-1))
    parts = list(zip(edges, [*edges[1:], len(block)]))
    flat = [(A[a:b].reshape(-1, A.shape[2]), y[a:b].reshape(-1)) for a, b in parts]
    return BlockSums(
        gram=np.stack([M.T @ M for M, _ in flat]),
        moment=np.stack([M.T @ v for M, v in flat]),
        power=np.array([v @ v for _, v in flat]),
        rows=np.array([len(v) for _, v in flat]),
    )


def block_bootstrap(sums: BlockSums, draws: int = 200, seed: int = 0) -> np.ndarray:
    """Return solutions (draws, d) for blocks drawn again with replacement; their covariance is that of the estimate.

    Parameters
    ----------
    sums : at least 8 blocks, each several correlation times long.
    draws : number of draws.
    seed : of the random generator.
    """
    count = len(sums.rows)
    if count < 8:
        raise ShapeError(f"Expected at least 8 blocks to draw from, got {count}. Record a longer log.")
    weights = np.random.default_rng(seed).multinomial(count, np.full(count, 1.0 / count), size=draws)
    return np.stack([sums.solve(w) for w in weights])


def correlation_time(x: np.ndarray, dt: float) -> float:
    """Return ``dt (1/2 + sum rho_k)`` [s] of a record (N,): the sum runs while pairs of autocorrelations are positive.

    The variance of a mean over T >> correlation_time is ``2 s^2 correlation_time / T`` (Geyer's initial positive
    sequence).
    """
    x = np.asarray(x, dtype=float) - np.mean(x)
    size = 2 ** int(np.ceil(np.log2(2 * len(x))))
    spectrum = np.fft.rfft(x, size)
    rho = np.fft.irfft(spectrum * np.conj(spectrum), size)[: len(x) // 2]
    if rho[0] <= 0:
        return 0.5 * dt
    rho = rho / rho[0]
    pairs = rho[0 : len(rho) // 2 * 2].reshape(-1, 2).sum(axis=1)
    end = int(np.argmax(pairs <= 0)) if np.any(pairs <= 0) else len(pairs)
    return dt * (pairs[:end].sum() - 0.5)


def effective_samples(x: np.ndarray) -> float:
    """Return the number of independent samples that tell as much about the mean as the record x (N,)."""
    return len(x) / max(2.0 * correlation_time(x, 1.0), 1.0)
