"""Three angles about three axes, in NumPy.

The axes come by number, in the order of the product: ``R = R_first(r) R_middle(p) R_last(y)``; neighbours differ.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from armlab.kernels._reference.arrays import elements, result
from armlab.kernels._reference.lie_arguments import rotations

__all__ = ["euler_from_rpy", "euler_to_rpy"]

LOCK = 1e-13  # below, the first and the last axis are parallel to the last digit


def euler_from_rpy(rpy: Any, first: int, middle: int, last: int, out: Any = None) -> np.ndarray:
    """The product of the three turns."""
    rpy = elements(rpy, "rpy", (3,))
    a, b, c = (_turn(rpy[..., k], axis) for k, axis in enumerate((first, middle, last)))
    return result(a @ b @ c, out, rpy=rpy)


def euler_to_rpy(R: Any, first: int, middle: int, last: int, out: Any = None) -> np.ndarray:
    """The angles, by what the first two turns make of the last axis; then the first is undone to see the last alone."""
    R = rotations(R, "R")
    i, j, k = first, middle, 3 - first - middle
    e = 1.0 if (j - i) % 3 == 1 else -1.0  # e_i × e_j = e e_k
    proper = last == i
    sine, cosine = (R[..., j, i], -e * R[..., k, i]) if proper else (-e * R[..., j, k], R[..., k, k])
    length = np.hypot(sine, cosine)
    r = np.where(length < LOCK, 0.0, _angle(sine, cosine))
    p = _angle(length, R[..., i, i]) if proper else _angle(e * R[..., i, k], length)
    row = np.cos(r)[..., None] * R[..., j, :] + e * np.sin(r)[..., None] * R[..., k, :]  # lock does not touch it
    y = _angle(-e * row[..., k] if proper else e * row[..., i], row[..., j])
    return result(np.stack([r, p, y], axis=-1), out, R=R)


def _angle(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """atan2, whatever the signs of zeros: a half turn is +π, and (0, 0) has the angle 0."""
    return np.arctan2(y + 0.0, x + 0.0)


def _turn(angle: np.ndarray, axis: int) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    R = np.zeros((*angle.shape, 3, 3))
    j, k = (axis + 1) % 3, (axis + 2) % 3
    R[..., axis, axis] = 1.0
    R[..., j, j], R[..., k, k], R[..., j, k], R[..., k, j] = c, c, -s, s
    return R
