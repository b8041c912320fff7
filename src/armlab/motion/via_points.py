"""A movement primitive that passes points on its way, or ends with a velocity."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import numbers
from armlab.errors import ConfigError, NotExcited, ShapeError
from armlab.motion.dmp import Dmp

FINE = 4000  # steps of the response over a duration, at least
GRID = 401  # times at which the change of the path is measured
RIDGE = 1e-7  # of the largest singular value: what the path does not tell of the weights stays as it is
SAME = 1e-10
ROUNDS = 3  # the last digits


def with_via_points(dmp: Dmp, t: ArrayLike, y: ArrayLike | None = None, yd: ArrayLike | None = None) -> Dmp:
    """Return the primitive whose own motion passes positions or velocities at given times, changed least elsewhere.

    The motion is linear in the weights, so points are linear conditions ``C dw = c``. Of all changes of the weights
    that meet them the one with the least ``sum |dy|^2`` over the duration is taken. The motion with the start, goal and
    duration of the demonstration passes the points; others scale with it.

    With the time of the end, its goal and a velocity the motion ends moving: hand it over there, to `profiles.quintic`
    or another primitive; if it runs on it comes back to the goal and settles.

    Parameters
    ----------
    dmp : with a phase of time. t : (k,) times since the start, in the time of the demonstration [s], above 0.
    y : (k, n) positions. yd : (k, n) velocities.

    Raises
    ------
    ShapeError : neither positions nor velocities, shapes, NaN, times outside the duration or twice.
    ConfigError : schedule "position". NotExcited : more points than the weights can meet.
    """
    if dmp.schedule == "position":
        raise ConfigError(
            "Expected a phase of time for via-points, got schedule 'position'. Use 'canonical' or 'time'."
        )
    times = np.atleast_1d(numbers(t, "t", ShapeError))
    inside = (
        times.ndim == 1 and np.isfinite(times).all() and np.all((times > 0.0) & (times <= dmp.duration * (1 + 1e-12)))
    )
    if not inside or len(np.unique(times)) != len(times):
        raise ShapeError(
            f"Expected different times (k,) above 0 and up to the duration, {dmp.duration:g} s, got {times.tolist()}."
        )
    wanted = [_points(values, what, len(times), dmp.n) for values, what in ((y, "y"), (yd, "yd")) if values is not None]
    if not wanted:
        raise ShapeError("Expected positions or velocities to pass, got neither. Give y or yd.")
    kinds = [k for k, values in enumerate((y, yd)) if values is not None]
    grid = np.unique(np.concatenate([np.linspace(0.0, dmp.duration, GRID), times]))
    responses = dmp.primitive.response(grid, dmp.tau_d, dmp.duration / FINE)
    rows = np.searchsorted(grid, times)
    C = np.concatenate([responses[k][rows, :-3] for k in kinds])
    change = _least_change(responses[0][:, :-3], C)
    ends = np.stack([dmp.y0, dmp.v0, dmp.g])
    constant = np.concatenate([responses[k][rows, -3:] for k in kinds]) @ ends
    weights = dmp.weights
    for _ in range(ROUNDS):
        weights = weights + change @ (np.concatenate(wanted) - constant - C @ weights)
    return replace(dmp, weights=weights)


def _least_change(Y: np.ndarray, C: np.ndarray) -> np.ndarray:
    """Return what makes changes of the weights (m, r) of what is missed: least ``|Y dw|`` with ``C dw`` as asked."""
    s, V = np.linalg.svd(Y, full_matrices=False)[1:]
    inverse = V.T / np.sqrt(s**2 + (RIDGE * s[0]) ** 2)  # of a root of the quadratic form
    steps = C @ inverse
    gram = steps @ steps.T
    values = np.linalg.eigvalsh(gram / np.sqrt(np.outer(gram.diagonal(), gram.diagonal())))
    if not values[0] > SAME:
        raise NotExcited(
            f"Expected points that {Y.shape[1]} weights can meet one by one, got some that are not independent. "
            "Give fewer, or further apart.",
            ["via-points"],
            [f"{values[0]:.1e}"],
        )
    return inverse @ steps.T @ np.linalg.inv(gram)


def _points(value: ArrayLike, what: str, k: int, n: int) -> np.ndarray:
    points = numbers(value, what, ShapeError)
    points = points.reshape(k, n) if points.size == k * n and points.ndim < 2 else points
    if points.shape != (k, n) or not np.isfinite(points).all():
        raise ShapeError(f"Expected finite {what} of shape ({k}, {n}), one row per time, got shape {points.shape}.")
    return points
