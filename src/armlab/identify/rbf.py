"""Centres and regressor of friction over position and speed: the ancestor's `getcenters` and `frictionRBFN`, corrected.

Against Robotlib.jl: widths belong to a joint; centres have speeds above 0 and stand for both directions; at rest the
presliding state blends both; the functions sum to 1 everywhere, without a constant in the denominator, and beyond the
centres the nearest edge counts, which `models.RadialBasis.outside` tells.
"""

from __future__ import annotations

import numpy as np

from armlab._numbers import numbers
from armlab.errors import NotExcited, ShapeError
from armlab.models import RadialBasis

__all__ = ["rbf_centres", "rbf_regressor"]

SLOWEST = 0.02  # of the peak speed: slower samples do not place centres


def rbf_centres(q: np.ndarray, qd: np.ndarray, positions: int = 8, speeds: int = 5) -> RadialBasis:
    """Return centres over the range of positions, evenly, and over the quantiles of speed, for every joint.

    Widths are the distances of neighbouring centres.

    Parameters
    ----------
    q, qd : (N, n) positions [rad] and velocities [rad/s] of a record.
    positions, speeds : number of centres of each, at least 2.

    Raises
    ------
    ShapeError : shapes, NaN, fewer than 2 centres. NotExcited : a joint that does not move.
    """
    q, qd = _record(q, qd)
    if min(positions, speeds) < 2:
        raise ShapeError(f"Expected at least 2 positions and speeds, got {positions} and {speeds}.")
    peak = np.abs(qd).max(axis=0)
    still = np.flatnonzero((np.ptp(q, axis=0) <= 0) | (peak <= 0))
    if len(still):
        names = [f"joint {i + 1}" for i in still]
        raise NotExcited(
            f"Expected every joint to move, got rest of {', '.join(names)}. Record a motion of all joints.",
            names,
            ["rest"] * len(names),
        )
    grid = np.linspace(q.min(axis=0), q.max(axis=0), positions, axis=1)
    levels = np.linspace(0.1, 1.0, speeds)
    quantiles = np.empty((q.shape[1], speeds))
    for i in range(q.shape[1]):
        speed = np.abs(qd[:, i])
        speed = np.quantile(speed[speed > SLOWEST * peak[i]], levels)
        apart = np.all(np.diff(speed) > SLOWEST * peak[i])  # constant speeds have quantiles on top of each other
        quantiles[i] = speed if apart else peak[i] * levels
    widths, speed_widths = (np.asarray(np.gradient(centres, axis=1)) for centres in (grid, quantiles))
    return RadialBasis(grid, widths, quantiles, speed_widths)


def rbf_regressor(q: np.ndarray, qd: np.ndarray, basis: RadialBasis, z: np.ndarray | None = None) -> np.ndarray:
    """Return the functions of every joint (N, n, 2 P S), positive direction first: friction is regressor times k.

    Parameters
    ----------
    q, qd : (N, n) positions [rad] and velocities [rad/s].
    basis : of the same n joints.
    z : (N, n) presliding state; the sign of qd when left out.

    Raises
    ------
    ShapeError : shapes that do not fit, NaN.
    """
    q, qd = _record(q, qd)
    z = np.sign(qd) if z is None else np.asarray(z, dtype=float)
    if q.shape[1] != basis.n or z.shape != q.shape or not np.isfinite(z).all():
        raise ShapeError(f"Expected finite q, qd and z of {basis.n} joints, got shapes {q.shape} and {z.shape}.")
    joints = [basis.functions(i, *(np.ascontiguousarray(x[:, i]) for x in (q, qd, z))) for i in range(basis.n)]
    return np.stack(joints, axis=1)


def _record(q: np.ndarray, qd: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    q, qd = numbers(q, "q", ShapeError), numbers(qd, "qd", ShapeError)
    if q.ndim != 2 or q.shape != qd.shape or not len(q) or not np.isfinite(q).all() or not np.isfinite(qd).all():
        raise ShapeError(
            f"Expected finite q and qd of one shape (N, n), got {q.shape} and {qd.shape}. Drop NaN rows first."
        )
    return q, qd
