"""Matrices of spatial vectors, twists [v; w] and wrenches [f; m]."""

from __future__ import annotations

import numpy as np

__all__ = ["UNIT_INERTIAS", "apply", "hat", "twist_cross", "twist_transform", "wrench_cross"]


def apply(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Return the product (..., m) of matrices (..., m, n) and vectors (..., n)."""
    return (matrix @ vector[..., None])[..., 0]


def hat(p: np.ndarray) -> np.ndarray:
    """Return (..., 3, 3) with ``hat(p) x = p x x``."""
    x, y, z = np.moveaxis(p, -1, 0)
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape((*p.shape, 3))


def twist_transform(T: np.ndarray) -> np.ndarray:
    """Return (..., 6, 6) Ad(T^-1): the twist of a body, told in frame b instead of a, for T = T_a_b."""
    R_transposed = np.swapaxes(T[..., :3, :3], -1, -2)
    X = np.zeros((*T.shape[:-2], 6, 6))
    X[..., :3, :3] = X[..., 3:, 3:] = R_transposed
    X[..., :3, 3:] = -R_transposed @ hat(T[..., :3, 3])
    return X


def twist_cross(V: np.ndarray) -> np.ndarray:
    """Return (..., 6, 6) V x: rate of change of a twist that is fixed in a body moving with V."""
    X = np.zeros((*V.shape, 6))
    X[..., :3, :3] = X[..., 3:, 3:] = hat(V[..., 3:])
    X[..., :3, 3:] = hat(V[..., :3])
    return X


def wrench_cross(V: np.ndarray) -> np.ndarray:
    """Return (..., 6, 6) V x*: the same for a wrench, -(V x)^T."""
    return -np.swapaxes(twist_cross(V), -1, -2)


def _unit_inertias() -> np.ndarray:
    """Return the (10, 6, 6) spatial inertia [[m 1, -hat(h)], [hat(h), I]] per unit of each of `pi`."""
    units = np.zeros((10, 6, 6))
    units[0, :3, :3] = np.eye(3)
    for k in range(3):
        h = hat(np.eye(3)[k])
        units[1 + k, :3, 3:], units[1 + k, 3:, :3] = -h, h
    for k, (row, column) in enumerate([(0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2)]):
        units[4 + k, 3 + row, 3 + column] = units[4 + k, 3 + column, 3 + row] = 1.0
    return units


UNIT_INERTIAS = _unit_inertias()
