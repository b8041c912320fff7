"""Numbers that were given to options, refused before any work begins."""

from __future__ import annotations

import math

from armlab.errors import ConfigError

__all__ = ["require_positive"]


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
