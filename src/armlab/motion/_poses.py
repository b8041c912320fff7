"""Poses of movement primitives: from what a user gives to positions and quaternions, or one sentence."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import numbers
from armlab.errors import ShapeError
from armlab.lie import quaternion, so3

__all__ = ["apart", "exp", "log", "matrix", "orientation", "pose", "poses"]

HALF_TURN = 1e-6  # rad: nearer to half a turn no shorter way is told
LENGTH = 1e-3  # error of a quaternion's length that is normalised away


def pose(value: ArrayLike, what: str) -> tuple[np.ndarray, np.ndarray]:
    """Return position (3,) and quaternion (4,) of a pose (4, 4) or (7,).

    Raises
    ------
    ShapeError : another shape, missing values, no rotation.
    """
    array = numbers(value, what, ShapeError)
    if array.shape not in ((4, 4), (7,)):
        raise ShapeError(
            f"Expected {what} as a pose (4, 4), or (7,): position, quaternion wxyz, got shape {array.shape}."
        )
    p, q = poses(array[None], what)
    return p[0], q[0]


def poses(value: ArrayLike, what: str) -> tuple[np.ndarray, np.ndarray]:
    """Return positions (N, 3) and quaternions (N, 4), without jumps of sign, of poses (N, 4, 4) or (N, 7).

    Raises
    ------
    ShapeError : another shape, missing values with their rows, no rotations.
    """
    array = numbers(value, what, ShapeError)
    if array.shape[1:] not in ((4, 4), (7,)):
        raise ShapeError(
            f"Expected {what} of shape (N, 4, 4), or (N, 7): position, quaternion wxyz, got {array.shape}. "
            "Put time on axis 0."
        )
    rows = np.flatnonzero(~np.isfinite(array.reshape(len(array), -1)).all(axis=1))
    if len(rows):
        raise ShapeError(
            f"Expected finite {what}, got NaN or Inf in row {rows[0]} ({len(rows)} in all). Leave those rows out."
        )
    if array.ndim == 2:
        return array[:, :3], quaternion.continuous(orientation(array[:, 3:], what))
    bottom = np.abs(array[:, 3] - [0.0, 0.0, 0.0, 1.0]).max() if len(array) else 0.0
    if bottom > 1e-9:
        raise ShapeError(f"Expected {what} with last rows 0, 0, 0, 1, got others. Give poses (N, 4, 4).")
    return array[:, :3, 3], quaternion.continuous(quaternion.from_matrix(array[:, :3, :3]))


def orientation(value: ArrayLike, what: str) -> np.ndarray:
    """Return quaternions (..., 4) of length 1, the first of them with the sign that a rotation matrix gives.

    Raises
    ------
    ShapeError : another shape or length.
    """
    q = numbers(value, what, ShapeError)
    if q.shape[-1:] != (4,):
        raise ShapeError(f"Expected {what} as quaternions wxyz (..., 4), got shape {q.shape}.")
    length = np.linalg.norm(q, axis=-1, keepdims=True)
    if not np.all(np.abs(length - 1.0) <= LENGTH):
        raise ShapeError(f"Expected quaternions of length 1 in {what}, got another length. Their order is wxyz.")
    first = q.reshape(-1, 4)[:1].ravel()
    leading = first[np.flatnonzero(first)[:1]] if first.size and first[0] == 0.0 else first[:1]
    return q / np.where(leading.sum() < 0.0, -length, length)


def apart(q0: np.ndarray, q1: np.ndarray) -> np.ndarray:
    """Return the rotation vector (3,) from one orientation to another on the shorter way, base axes.

    Raises
    ------
    ShapeError : half a turn, where both ways are as long.
    """
    way = log(quaternion.multiply(q1, quaternion.conjugate(q0)))
    if np.linalg.norm(way) > np.pi - HALF_TURN:
        raise ShapeError(
            "Expected start and goal less than half a turn apart, got half a turn: both ways are as long. Go by way of "
            "another orientation."
        )
    return way


def log(q: np.ndarray) -> np.ndarray:
    """Return rotation vectors (..., 3) of least length."""
    q = np.where(q[..., :1] < 0.0, -q, q)
    length = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(length, q[..., :1])
    return np.where(length > 0.0, angle / np.where(length > 0.0, length, 1.0), 2.0) * q[..., 1:]


def exp(w: np.ndarray) -> np.ndarray:
    """Return quaternions (..., 4) of rotation vectors."""
    half = 0.5 * np.linalg.norm(w, axis=-1, keepdims=True)
    return np.concatenate([np.cos(half), 0.5 * np.sinc(half / np.pi) * w], axis=-1)


def matrix(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return poses (..., 4, 4)."""
    T = np.zeros((*p.shape[:-1], 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = quaternion.to_matrix(q), p, 1.0
    return T


def turn(q0: np.ndarray, q1: np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) from one orientation to another, base axes."""
    return so3.exp(log(quaternion.multiply(q1, quaternion.conjugate(q0))))
