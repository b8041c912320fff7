"""Motion in pieces of polynomials: evaluation and extremes, exact."""

from __future__ import annotations

import numpy as np

__all__ = ["evaluate", "peaks", "rising", "stretched"]

DEGREE = 5
LINE = np.arange(DEGREE + 1.0)


def evaluate(breaks: np.ndarray, c: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return q, qd, qdd (..., n) of ``q = sum_k c_k (t - breaks_i)^k`` at times (...,) within the breaks.

    Parameters
    ----------
    breaks : (M + 1,) rising [s]. c : (M, 6, n). t : (...,) [s].
    """
    piece = np.clip(np.searchsorted(breaks, t, side="right") - 1, 0, len(c) - 1)
    s, found = (t - breaks[piece])[..., None], c[piece]
    values = []
    for order in range(3):
        value = found[..., -1, :]
        for k in range(found.shape[-2] - 2, -1, -1):
            value = value * s + found[..., k, :]
        values.append(value)
        found = LINE[1 : found.shape[-2], None] * found[..., 1:, :] if order < 2 else found
    return values[0], values[1], values[2]


def peaks(breaks: np.ndarray, c: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest ``|qd|`` and ``|qdd|`` (n,), at the ends of pieces or where the next derivative is zero."""
    first = LINE[1:, None] * c[:, 1:]
    second = LINE[1:-1, None] * first[:, 1:]
    third = LINE[1:-2, None] * second[:, 1:]
    lengths = np.diff(breaks)
    return _largest(first, second, lengths), _largest(second, third, lengths)


def _largest(p: np.ndarray, derivative: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    found = np.maximum(np.abs(p[:, 0]), np.abs(_at(p, lengths[:, None]))).max(axis=0)
    if np.any(derivative[:, 2:]):  # of higher than first order: few pieces
        for piece, joint in np.ndindex(p.shape[0], p.shape[2]):
            roots = np.roots(derivative[piece, ::-1, joint])
            real = roots.real[(np.abs(roots.imag) <= 1e-7 * (1.0 + np.abs(roots))) & (roots.real > 0.0)]
            inside = np.minimum(real, lengths[piece])
            if len(inside):
                values = np.abs(np.polyval(p[piece, ::-1, joint], inside))
                found[joint] = max(found[joint], values.max())
        return found
    slope = np.where(derivative[:, 1] == 0.0, 1.0, derivative[:, 1])
    where = np.where(derivative[:, 1] == 0.0, 0.0, -derivative[:, 0] / slope)
    return np.maximum(found, np.abs(_at(p, np.clip(where, 0.0, lengths[:, None]))).max(axis=0))


def _at(p: np.ndarray, s: np.ndarray) -> np.ndarray:
    value = p[:, -1]
    for k in range(p.shape[1] - 2, -1, -1):
        value = value * s + p[:, k]
    return value


def stretched(breaks: np.ndarray, c: np.ndarray, k: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the same path, k times as slow."""
    return breaks * k, c / k ** LINE[:, None]


def rising(duration: float, blend: float) -> tuple[np.ndarray, np.ndarray]:
    """Return breaks and coefficients (M, 6, 1) of the step 0 to 1 with quadratic blends of `blend` seconds and a line.

    ``V = 1 / (duration - blend)``, ``a = V / blend``; without a line where ``blend = duration / 2``.
    """
    V = 1.0 / (duration - blend)
    half = 0.5 * V / blend
    at = 0.5 * V * blend  # after the first blend
    c = np.zeros((3, DEGREE + 1, 1))
    c[0, 2] = half
    c[1, :2, 0] = at, V
    c[2, :3, 0] = 1.0 - at, V, -half
    breaks = np.array([0.0, blend, duration - blend, duration])
    line = breaks[2] > breaks[1]
    return (breaks, c) if line else (breaks[[0, 1, 3]], c[[0, 2]])
