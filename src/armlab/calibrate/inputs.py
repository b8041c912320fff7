"""Validation of calibration arguments: poses, points and their noise."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import numbers, rows_text
from armlab.errors import ShapeError
from armlab.lie import so3


def finite(values: np.ndarray, name: str) -> None:
    """Raise an error that lists the rows with NaN or infinity."""
    if not np.isfinite(values).all():
        bad = np.flatnonzero(~np.isfinite(values).reshape(len(values), -1).all(axis=1))
        raise ShapeError(
            f"Expected finite {name}, got NaN or Inf in {len(bad)} rows: {rows_text(bad)}. Remove these samples from "
            "all records."
        )


def poses(value: ArrayLike, name: str) -> tuple[np.ndarray, np.ndarray, str]:
    """Return the rotations (N, 3, 3) and positions (N, 3) of poses, and a remark on projected rotations."""
    T = numbers(value, name, ShapeError)
    if T.ndim != 3 or T.shape[1:] != (4, 4):
        raise ShapeError(f"Expected {name} of shape (N, 4, 4), got {T.shape}. Pass one pose per sample.")
    finite(T, name)
    if not (T[:, 3] == (0.0, 0.0, 0.0, 1.0)).all():
        bad = np.flatnonzero((T[:, 3] != (0.0, 0.0, 0.0, 1.0)).any(axis=1))
        raise ShapeError(
            f"Expected (0, 0, 0, 1) as the last row of every pose in {name}, got other values in rows "
            f"{rows_text(bad)}. Check whether the matrices are transposed."
        )
    R, note = _rotations(T[:, :3, :3].copy(), name)
    return R, T[:, :3, 3].copy(), note


def orientations(value: ArrayLike, name: str) -> tuple[np.ndarray, str]:
    """Return the rotations (N, 3, 3) of poses or rotations, and a remark on projected rotations."""
    values = numbers(value, name, ShapeError)
    if values.ndim == 3 and values.shape[1:] == (4, 4):
        R, _, note = poses(values, name)
        return R, note
    if values.ndim != 3 or values.shape[1:] != (3, 3):
        raise ShapeError(
            f"Expected {name} of shape (N, 4, 4) or (N, 3, 3), got {values.shape}. Pass one orientation per sample."
        )
    return _rotations(values.copy(), name)


def _rotations(R: np.ndarray, name: str) -> tuple[np.ndarray, str]:
    """Return R (N, 3, 3), projected if slightly inexact, and a remark on the projection."""
    finite(R, name)
    off = np.abs(R.transpose(0, 2, 1) @ R - np.eye(3)).reshape(len(R), 9).max(axis=1, initial=0.0)
    wrong = off > so3.ROTATION_TOLERANCE
    if wrong.any():
        raise ShapeError(
            f"Expected rotations in {name}, got matrices that deviate by up to {off.max():.2g} from "
            f"orthonormality in rows {rows_text(np.flatnonzero(wrong))}. Project the matrices "
            "with lie.so3.project if they are meant to be rotations."
        )
    mirrored = np.flatnonzero(np.linalg.det(R) < 0)
    if len(mirrored):
        raise ShapeError(
            f"Expected rotations in {name}, got left-handed axes in rows {rows_text(mirrored)}. "
            "One axis of the frame is reversed."
        )
    note, near = "", off > so3.NEGLIGIBLE
    if near.any():
        R = so3.orthonormalise(R)
        note = (
            f"{np.count_nonzero(near)} rotations in {name} deviated by "
            f"up to {off.max():.2g} from orthonormality and were projected"
        )
    return R, note


def gravity_of(gravity: Any) -> np.ndarray:
    g = numbers(gravity, "gravity", ShapeError)
    if g.shape != (3,) or not 0.0 < g @ g < np.inf:
        raise ShapeError(
            f"Expected gravity to be three finite numbers [m/s^2] in base axes, not all zero, got {gravity!r}. "
            "Pass (0, 0, -9.80665) for an upright base."
        )
    return g


def pose_noise(noise: Any, N: int, name: str = "noise") -> np.ndarray | None:
    """Return pose variances (6,) or covariances (6, 6) or (N, 6, 6), which may be zero; None without noise."""
    wanted = "poses as (sd of position [m], sd of rotation [rad])"
    return noise_of(noise, 2, (N,), name, wanted, "Pass one number in metres and one in radians.", zero=True)


def point_noise(noise: Any, shape: tuple[int, ...]) -> np.ndarray | None:
    """Return point variances (3,) or covariances (3, 3) or (*shape, 3, 3); None without noise."""
    return noise_of(noise, 1, shape, "noise", "points as one standard deviation above zero [m]")


def noise_of(
    noise: Any, groups: int, batch: tuple[int, ...], name: str, wanted: str, advice: str = "Correct the noise.",
    zero: bool = False,
) -> np.ndarray | None:  # fmt: skip
    """Return variances (k,) or a covariance (k, k) or (*batch, k, k), with k = 3 * groups; None without noise."""
    if noise is None:
        return None
    values, k = numbers(noise, name, ShapeError), 3 * groups
    if zero and values.ndim == 0 and values == 0.0:
        return np.zeros(k)
    sds = values[None] if groups == 1 and values.ndim == 0 else values
    if sds.shape == (groups,) and np.isfinite(sds).all() and np.all(sds >= 0 if zero else sds > 0):
        return np.repeat(sds**2, 3)
    if values.shape not in ((k, k), (*batch, k, k)) or not np.isfinite(values).all():
        wide = ", ".join(str(n) for n in (*batch, k, k))
        got = repr(noise) if values.size <= k else f"shape {values.shape}"
        raise ShapeError(f"Expected {name} of {wanted} or as a covariance ({k}, {k}) or ({wide}), got {got}. {advice}")
    size = np.abs(values).max()
    even = np.abs(values - np.swapaxes(values, -1, -2)).max() <= 1e-9 * size
    if not even or np.linalg.eigvalsh(values).min() < -1e-12 * size:
        raise ShapeError(
            f"Expected symmetric, positive semidefinite covariances in {name}, got other matrices. Correct {name}."
        )
    return values
