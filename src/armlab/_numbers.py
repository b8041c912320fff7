"""Validation of user input as arrays of real numbers or as tuples."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from reprlib import repr as shortened
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from armlab.errors import ArmlabError, RobotError, ShapeError, UnknownName


def numbers(value: ArrayLike, what: str, error: type[ArmlabError] = RobotError) -> np.ndarray:
    """Return real numbers as float64, without a copy if possible; raise `error` for anything else.

    NumPy alone would parse digit strings and drop imaginary parts. `what` names the value in the message.
    """
    try:
        array = np.asarray(value)
    except ValueError:  # rows of different length
        array = np.array(None)
    if array.dtype.kind not in "biuf":
        raise error(f"Expected {what} to be real numbers, got {shortened(value)}.")
    return array.astype(np.float64, copy=False)


def members(value: Any, what: str, error: type[ArmlabError] = RobotError) -> tuple[Any, ...]:
    """Return the items of an iterable as a tuple; raise an error for strings, although Python can iterate over them."""
    if (
        isinstance(value, str | bytes)
        or not isinstance(value, Iterable)
        or (isinstance(value, np.ndarray) and not value.ndim)
    ):
        raise error(f"Expected {what} to be a list or tuple, got {shortened(value)}.")
    return tuple(value)


def frozen(value: ArrayLike, what: str) -> np.ndarray:
    """Return real numbers as a read-only copy with -0.0 replaced by 0.0, so equal values have equal bytes."""
    array = np.array(numbers(value, what))
    array += 0.0
    array.flags.writeable = False
    return array


def still(value: ArrayLike, what: str) -> np.ndarray:
    """Return real numbers as a bit-identical read-only copy."""
    array = np.array(numbers(value, what, ShapeError))
    array.flags.writeable = False
    return array


def make_read_only(result: Any, *names: str) -> None:
    """Replace arrays of a frozen dataclass with read-only views."""
    for name in names:
        array = getattr(result, name)
        if not isinstance(array, np.ndarray):
            raise ShapeError(
                f"Expected {name} of a {type(result).__name__} to be a NumPy array, got {shortened(array)}."
            )
        view = array.view()
        view.flags.writeable = False
        object.__setattr__(result, name, view)


def flag(value: Any, what: str) -> bool:
    """Return a bool; raise an error for anything else, because non-empty lists and strings would count as True."""
    if not isinstance(value, bool | np.bool_):
        raise ShapeError(f"Expected {what} to be True or False, got {shortened(value)}.")
    return bool(value)


def number(value: Any, what: str, error: type[ArmlabError] = ShapeError) -> float:
    """Return one real number (including infinity and NaN); raise `error` for anything else.

    `what` includes the unit.
    """
    if type(value) is float:
        return value
    array = numbers(value, what, error)
    if array.ndim:
        raise error(f"Expected {what} to be one number, got {shortened(value)}.")
    return float(array)


def positive(value: Any, what: str, advice: str = "Correct it.", error: type[ArmlabError] = ShapeError) -> float:
    """Return one finite number above zero; raise `error`, whose message ends with `advice`, for anything else."""
    found = number(value, what, error)
    if not 0.0 < found < np.inf:
        raise error(f"Expected a finite {what} above zero, got {found:g}. {advice}")
    return found


def check_name(value: Any, what: str, names: Collection[str]) -> None:
    """Raise UnknownName unless `value` is a string in `names`; an array never matches."""
    if not isinstance(value, str) or value not in names:
        raise UnknownName.among(what, value, names)


def generator(seed: Any) -> np.random.Generator:
    """Return a random generator for a seed, or the given generator."""
    whole = isinstance(seed, int | np.integer) and not isinstance(seed, bool) and seed >= 0
    if not whole and not isinstance(seed, np.random.Generator):
        raise ShapeError(
            f"Expected seed to be a non-negative integer, got {shortened(seed)}. Use, for example, seed=0."
        )
    return np.random.default_rng(seed)


def rows_text(rows: np.ndarray) -> str:
    """Return row numbers as text for a message, at most the first twenty."""
    shown = ", ".join(str(i) for i in rows[:20])
    return shown if len(rows) <= 20 else f"{shown} and {len(rows) - 20} more"
