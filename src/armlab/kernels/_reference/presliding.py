"""Presliding friction state along a record (specification; the compiled twin is native/estimator.cpp)."""

from __future__ import annotations

import numpy as np

__all__ = ["presliding"]


def presliding(q: np.ndarray, delta: np.ndarray, resolution: np.ndarray) -> np.ndarray:
    """Return the presliding state z (N, n) in [-1, 1] along positions `q` (N, n) [rad], from 0 at the first row.

    ``z_k = s + (z_{k-1} - s) exp(-|dy_k| / delta)``, s = sign(dy_k), where y follows q with a play of +-resolution, so
    that the last digit of an encoder at rest does not wear the state down. A row with a NaN gives NaN and changes
    nothing.

    Parameters
    ----------
    q : (N, n) positions in time order.
    delta : (n,) presliding distance [rad].
    resolution : (n,) half the play [rad].
    """
    q = np.asarray(q, dtype=float)
    z = np.zeros(q.shape)
    current = np.zeros(q.shape[1])
    play, started = np.zeros(q.shape[1]), False
    for k, row in enumerate(q):
        if not np.all(np.isfinite(row)):
            z[k] = np.nan
            continue
        if not started:
            play, started = row.copy(), True
        moved = np.clip(play, row - resolution, row + resolution)
        current, play = slide(current, moved - play, delta), moved
        z[k] = current
    return z


def slide(z: np.ndarray, dy: np.ndarray, delta: np.ndarray) -> np.ndarray:
    """Advance the state z (n,) by the displacement dy (n,)."""
    sign = np.sign(dy)
    return sign + (z - sign) * np.exp(-np.abs(dy) / delta)
