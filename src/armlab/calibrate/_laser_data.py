"""Scans of plates as a user gives them, checked once: lines or raw profiles, labels, noise."""

from __future__ import annotations

from typing import Any

import numpy as np

from armlab._numbers import numbers
from armlab.calibrate._arguments import finite, poses, rows_text
from armlab.calibrate._laser_equation import Scans
from armlab.errors import ShapeError

FAT = 0.2  # width over length of a profile beyond which it is no line


def scans_of(T_base_tool: Any, scans: Any, plane: Any, noise: Any) -> tuple[Scans, tuple[str, ...], str]:
    """Return the scans, the labels of the plates, and what must be reported of the poses."""
    RA, tA, note = poses(T_base_tool, "T_base_tool")
    N = len(RA)
    labels = np.asarray(plane)
    if labels.shape != (N,) or labels.dtype.kind not in "iuUS":
        raise ShapeError(
            f"Expected one label per scan in plane, {N} whole numbers or texts, got {labels.dtype} of shape "
            f"{labels.shape}. Say on which plate each scan lies."
        )
    names, number = np.unique(labels, return_inverse=True)
    p, line, points, owner = _lines(scans, N)
    cov = _noise(noise, 2 if points is None else 1)
    return Scans(RA, tA, number, p, line, points, owner, cov), tuple(str(name) for name in names), note


def _lines(scans: Any, N: int) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, np.ndarray]:
    """Return point and direction (N, 2) of each scan; raw points (M, 2) and their scans where these came."""
    if getattr(scans, "ndim", None) == 2 or (len(scans) and np.ndim(scans[0]) == 1):
        values = numbers(scans, "scans", ShapeError)
        if values.shape != (N, 4):
            raise ShapeError(_shape_text(N, values.shape))
        finite(values, "scans")
        lengths = np.linalg.norm(values[:, 2:], axis=1)
        bad = np.flatnonzero(np.abs(lengths - 1.0) > 1e-6)
        if len(bad):
            raise ShapeError(
                f"Expected unit directions in columns 3 and 4 of scans, got other lengths in rows {rows_text(bad)}. "
                "Divide them by their length."
            )
        return values[:, :2], values[:, 2:] / lengths[:, None], None, np.arange(N)
    profiles = [numbers(one, f"profile {i}", ShapeError) for i, one in enumerate(scans)]
    if len(profiles) != N or any(one.ndim != 2 or one.shape[1:] != (2,) for one in profiles):
        raise ShapeError(_shape_text(N, [one.shape for one in profiles[:3]]))
    bad = np.array([i for i, one in enumerate(profiles) if not np.isfinite(one).all()], dtype=int)
    if len(bad):
        raise ShapeError(
            f"Expected finite scans, got NaN or Inf in {len(bad)} rows: {rows_text(bad)}. Leave these points out."
        )
    short = np.array([i for i, one in enumerate(profiles) if len(one) < 2 or not np.ptp(one, axis=0).any()], dtype=int)
    if len(short):
        raise ShapeError(
            f"Expected profiles of two points or more, got fewer in rows {rows_text(short)}. Leave them out."
        )
    p = np.array([one.mean(axis=0) for one in profiles])
    shapes = [np.linalg.svd(one - middle, full_matrices=False) for one, middle in zip(profiles, p)]
    fat = np.array([i for i, (_, s, _) in enumerate(shapes) if s[1] > FAT * s[0]], dtype=int)
    if len(fat):
        raise ShapeError(
            f"Expected profiles of flat plates, got what is no line in rows {rows_text(fat)}. Cut them to the plate."
        )
    owner = np.repeat(np.arange(N), [len(one) for one in profiles])
    return p, np.array([V[0] for _, _, V in shapes]), np.concatenate(profiles), owner


def _shape_text(N: int, got: Any) -> str:
    return (
        f"Expected {N} scans, one per pose: lines of shape ({N}, 4), point and unit direction in the laser plane, or "
        f"profiles of shape (K, 2) each, got {got}. Pair them with the poses first."
    )


def _noise(noise: Any, count: int) -> np.ndarray | None:
    if noise is None:
        return None
    values = np.atleast_1d(numbers(noise, "noise", ShapeError))
    if values.shape != (count,) or not np.all(values > 0) or not np.isfinite(values).all():
        usual = "(sd of points [m], sd of angles [rad]) of lines" if count == 2 else "one sd of raw points [m]"
        raise ShapeError(f"Expected noise as {usual}, above zero, got {noise!r}. Correct it.")
    return values**2
