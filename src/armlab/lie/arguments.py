"""Argument checks for functions that have no compiled kernel. NaN is accepted, so missing values remain missing."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from armlab.errors import ShapeError

ROTATION_TOLERANCE = 1e-5


def array(value: ArrayLike, tail: tuple[int, ...], name: str) -> np.ndarray:
    """Return `value` as float64; raise an error unless its shape ends with `tail`."""
    try:
        result = np.asarray(value)
    except (TypeError, ValueError):
        result = None
    if result is None or not np.can_cast(result.dtype, np.float64, "safe"):
        raise ShapeError(
            f"Expected {name} to be an array of real numbers, got {type(value).__name__} that cannot be converted "
            "to float64. Pass a NumPy array or nested lists of equal length."
        )
    if result.shape[max(result.ndim - len(tail), 0) :] != tail:
        raise ShapeError(f"Expected {name} of shape ({', '.join(['...', *map(str, tail)])}), got {result.shape}.")
    return result.astype(np.float64, copy=False)


def broadcasts(**arguments: tuple[np.ndarray, int]) -> None:
    """Raise an error unless the leading axes broadcast; each argument is a pair (array, number of axes of one
    element)."""
    try:
        np.broadcast_shapes(*(value.shape[: value.ndim - axes] for value, axes in arguments.values()))
    except ValueError:
        got = ", ".join(f"{name} of shape {value.shape}" for name, (value, _) in arguments.items())
        raise ShapeError(f"Expected leading axes that broadcast, got {got}.") from None


def tolerance(value: float) -> float:
    """Return a tolerance as float; raise an error unless it is a single number >= 0."""
    number = array(value, (), "tolerance")
    if number.ndim or not number >= 0.0:
        raise ShapeError(f"Expected a tolerance >= 0, got {value!r}. The default is 1e-5.")
    return float(number)
