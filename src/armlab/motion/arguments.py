"""Argument checks for motions: points, limits, durations and times as arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import number, numbers, positive
from armlab.errors import ConfigError, ShapeError

MAX_SAMPLES = 10_000_000
FEWEST, MOST = 3, 1000  # smallest and largest number of kernels


def point(value: Any, what: str) -> np.ndarray:
    """Return a point (n,); a single number is a point with one joint."""
    array = np.atleast_1d(numbers(value, what, ShapeError))
    if array.ndim != 1 or not array.size or not np.isfinite(array).all():
        came = str(array.tolist()) if array.ndim == 1 and array.size else f"shape {array.shape}"
        raise ShapeError(f"Expected {what} to be finite positions (n,), got {came}. Pass one number per joint.")
    return array


def second_point(value: Any, what: str, first: np.ndarray) -> np.ndarray:
    """Return a point with the same number of joints as the first point."""
    array = point(value, what)
    if array.shape != first.shape:
        raise ShapeError(
            f"Expected {what} of {first.size} joints, like the first point, got {array.size} joints. Pass "
            "two points of the same arm."
        )
    return array


def points(value: Any, what: str) -> np.ndarray:
    """Return points (m, n) in order; (m,) is a path for one joint."""
    array = numbers(value, what, ShapeError)
    array = array[:, None] if array.ndim == 1 else array
    if array.ndim != 2 or len(array) < 2 or not array.shape[1]:
        raise ShapeError(
            f"Expected {what} of shape (m, n) with at least 2 points, got shape {array.shape}. Pass one row per point."
        )
    missing = np.flatnonzero(~np.isfinite(array).all(axis=1))
    if len(missing):
        raise ShapeError(
            f"Expected finite {what}, got missing values in point {missing[0]} ({len(missing)} in total). Omit "
            "these points."
        )
    return array


def velocity(value: Any, what: str, n: int) -> np.ndarray:
    """Return a finite velocity or acceleration (n,); a scalar applies to all joints."""
    return _per_joint(value, what, n, np.isfinite, "finite")


def joint_limit(value: Any, what: str, n: int) -> np.ndarray:
    """Return a positive limit (n,), possibly infinite; a scalar applies to all joints."""
    return _per_joint(value, what, n, lambda x: x > 0.0, "above zero")


def at_least_zero(value: Any, what: str) -> float:
    """Return one finite, non-negative number."""
    found = number(value, what, ConfigError)
    if not 0.0 <= found < np.inf:
        raise ConfigError(f"Expected a finite {what} of at least 0, got {found:g}. Correct it.")
    return found


def kernel_count(value: Any, usual: int) -> int:
    """Return the number of kernels."""
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not whole or not FEWEST <= value <= MOST:
        raise ConfigError(
            f"Expected an integer number of kernels from {FEWEST} to {MOST}, got {value!r}. The default is {usual}."
        )
    return int(value)


def _per_joint(value: Any, what: str, n: int, allowed: Any, word: str) -> np.ndarray:
    array = numbers(value, what, ShapeError)
    if array.shape not in ((), (n,)):
        raise ShapeError(f"Expected {what} to be one number or of shape ({n},), got shape {array.shape}.")
    array = np.array(np.broadcast_to(array, (n,)))
    if not np.all(allowed(array)):
        raise ShapeError(f"Expected {what} {word}, got {array.tolist()}. Correct it.")
    return array


def clock(t: ArrayLike, end: float) -> np.ndarray:
    """Return times (N,) as given, or from 0 to the end in steps of t [s]."""
    times = numbers(t, "t", ShapeError)
    if times.ndim:
        return times
    step = positive(times, "dt", "At 250 Hz, dt is 0.004 s.")
    if not end / MAX_SAMPLES <= step <= end * (1 + 1e-12):
        raise ShapeError(
            f"Expected dt [s] between {end / MAX_SAMPLES:.2g} and the duration {end:g}, got {step:g}. At 250 Hz, dt "
            "is 0.004 s."
        )
    return step * np.arange(int(np.floor(end / step * (1 + 1e-12))) + 1)


def vector(value: ArrayLike, what: str, n: int) -> np.ndarray:
    """Return finite numbers (..., n), one per coordinate."""
    array = numbers(value, what, ShapeError)
    if array.ndim < 1 or array.shape[-1] != n:
        raise ShapeError(f"Expected {what} with {n} coordinates on its last axis, got shape {array.shape}.")
    if not np.isfinite(array).all():
        raise ShapeError(
            f"Expected a finite {what}, got {array}. Omit this argument to use the value of the demonstration."
        )
    return array


def coordinates(value: ArrayLike, what: str, n: int) -> np.ndarray:
    """Return finite numbers (n,), one per coordinate."""
    array = vector(value, what, n)
    if array.ndim != 1:
        raise ShapeError(f"Expected {what} of shape ({n},), got {array.shape}. Pass one number per coordinate.")
    return array
