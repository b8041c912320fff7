"""How long a record remembers, and how many independent samples it is worth."""

from __future__ import annotations

import numpy as np

from armlab._numbers import number, numbers
from armlab.errors import ShapeError

__all__ = ["block_seconds", "correlation_time", "effective_samples"]

SHORTEST = 0.5  # s
MEMORIES = 4.0


def correlation_time(x: np.ndarray, dt: float) -> float:
    """Return ``dt (1/2 + sum rho_k)`` [s] of a record (N,): the sum runs while pairs of autocorrelations are positive.

    The variance of a mean over T >> correlation_time is ``2 s^2 correlation_time / T`` (Geyer's initial positive
    sequence).

    Parameters
    ----------
    x : (N,) evenly sampled record. dt : time between samples [s].

    Raises
    ------
    ShapeError : fewer than two samples, NaN.
    """
    x = numbers(x, "a record", ShapeError)
    if x.ndim != 1 or len(x) < 2 or not np.isfinite(x).all():
        raise ShapeError(
            f"Expected a finite record (N,) of at least two samples, got shape {x.shape} with "
            f"{np.count_nonzero(~np.isfinite(x))} NaN or Inf. Drop the missing samples."
        )
    x = x - np.mean(x)
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
    """Return the number of independent samples that tell as much about the mean as the record x (N,), N > 1."""
    return len(x) / max(2.0 * correlation_time(x, 1.0), 1.0)


def block_seconds(residuals: np.ndarray, dt: float) -> float:
    """Return how long a block is to last so that blocks are independent: ``max(0.5 s, 4 t_int)`` of the worst column.

    Parameters
    ----------
    residuals : (N, k) evenly sampled, finite. dt : time between samples [s].
    """
    residuals, dt = numbers(residuals, "residuals", ShapeError), number(dt, "the time between samples [s]")
    return max([SHORTEST, *(MEMORIES * correlation_time(column, dt) for column in np.transpose(residuals))])
