"""What was given to options, refused before any work begins."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager

from armlab.errors import ConfigError, ShapeError

__all__ = ["as_given", "require_positive"]


@contextmanager
def as_given() -> Iterator[None]:
    """Take what the library refuses as wrong use: the block, or function, works on the words of a command alone.

    Raises
    ------
    ConfigError : with the sentence of the library.
    """
    try:
        yield
    except ShapeError as error:
        raise ConfigError(str(error)) from error


def require_positive(option: str, value: float | None, unit: str = "") -> None:
    """Refuse a number that is not above zero and finite; None was not given.

    Parameters
    ----------
    option : its name, without hyphens. value : as given. unit : of the number, for the message.

    Raises
    ------
    ConfigError : NaN, infinite, zero or below.
    """
    if value is not None and not (math.isfinite(value) and value > 0.0):
        raise ConfigError(f"Expected --{option} above 0{f' {unit}' if unit else ''} and finite, got {value:g}.")
