"""The fastest way along a path: time-optimal parameterisation under limits of velocity and acceleration."""

from __future__ import annotations

import numpy as np

__all__ = ["fastest", "top"]

BISECTIONS = 45  # of the largest squared rate at a knot: to 3e-14 of it


def fastest(h: float, slope: np.ndarray, bend: np.ndarray, v_max: np.ndarray, a_max: np.ndarray) -> np.ndarray:
    """Return the squared rate ``z = s'^2`` (M + 1,) at knots, at most 1, with which a path y(s) is run soonest.

    Velocity is ``y_s sqrt(z)``, acceleration ``y_ss z + y_s z_s / 2``. With z linear between knots, both are linear
    inequalities of neighbours: backwards the largest z from which the end can be reached, forwards the largest that
    can be reached from there.

    Parameters
    ----------
    h : between knots [s]. slope, bend : (M + 1, n) first and second derivative of the path. v_max, a_max : (n,) limits.

    References
    ----------
    Pham and Pham, A new approach to time-optimal path parameterization based on reachability analysis, IEEE
    Transactions on Robotics 34(3), 2018.
    """
    with np.errstate(divide="ignore"):
        cap = np.minimum(1.0, np.min((v_max / np.abs(slope)) ** 2, axis=1))
    # a z + b z_next <= 1 at both ends of every interval, in both directions: (M, 4 n)
    turn, bent = slope / (2 * h * a_max), bend / a_max
    before = np.concatenate([bent[:-1] - turn[:-1], -turn[1:]], axis=1)
    after = np.concatenate([turn[:-1], bent[1:] + turn[1:]], axis=1)
    a, b = np.concatenate([before, -before], axis=1), np.concatenate([after, -after], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        rises, falls = b > 0.0, (b < 0.0) & (a > 0.0)
        over_b, over_a = np.where(b != 0.0, 1.0 / b, 0.0), np.where(falls, 1.0 / a, np.inf)
        up, up_slope = np.where(rises, over_b, np.inf), np.where(rises, -a * over_b, 0.0)
        down, down_slope = over_a, np.where(falls, -b / a, 0.0)
    most = np.minimum(cap[:-1], _alone(a, b, cap))
    reachable = cap.copy()
    for i in range(len(most) - 1, -1, -1):
        reachable[i] = min(most[i], (down[i] + down_slope[i] * reachable[i + 1]).min())
    z = reachable
    for i in range(len(most)):
        z[i + 1] = min(z[i + 1], (up[i] + up_slope[i] * z[i]).min())
    return z


def _alone(a: np.ndarray, b: np.ndarray, cap: np.ndarray) -> np.ndarray:
    """Return the largest z (M,) for which any next one fulfils the inequalities of one interval."""
    with np.errstate(divide="ignore", invalid="ignore"):
        over = np.where(b != 0.0, 1.0 / b, 0.0)
    flat, rises, falls = b == 0.0, b > 0.0, b < 0.0
    low, high = np.zeros(len(a)), cap[:-1].copy()
    for _ in range(BISECTIONS):
        z = 0.5 * (low + high)
        left = 1.0 - a * z[:, None]
        bound = left * over
        least = np.max(np.where(falls, bound, 0.0), axis=1)
        largest = np.minimum(cap[1:], np.min(np.where(rises, bound, np.inf), axis=1))
        fits = (least <= largest) & (np.where(flat, left, 0.0).min(axis=1) >= 0.0)
        low, high = np.where(fits, z, low), np.where(fits, high, z)
    return np.where(high == cap[:-1], high, low)


def top(values: np.ndarray) -> np.ndarray:
    """Return the largest size (n,) of functions of which pieces (M, P, n) have even samples, between them too.

    Parameters
    ----------
    values : P >= 3 samples of each smooth piece; the parabola through three has the peak between them.
    """
    size = np.abs(values)
    before, at, after = size[:, :-2], size[:, 1:-1], size[:, 2:]
    bend = before - 2 * at + after
    inside = (at >= before) & (at >= after) & (bend < 0.0)
    rise = np.where(inside, -((after - before) ** 2) / (8 * np.where(inside, bend, 1.0)), 0.0)
    return np.maximum(size.max(axis=(0, 1)), (at + rise).max(axis=(0, 1)))
