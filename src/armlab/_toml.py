"""TOML of users: whatever is wrong with a text is told as one error."""

from __future__ import annotations

import tomllib
from typing import Any

__all__ = ["TomlError", "parsed"]

_LARGEST = 2**63


class TomlError(ValueError):
    """A text that is no TOML."""


def parsed(text: str) -> dict[str, Any]:
    """Return the tables of a TOML text.

    The parser of Python takes integers of any length, up to those for which it raises something else, and nests as
    deep as Python may.

    Raises
    ------
    TomlError : no TOML, nested too deep, an integer beyond 64 bits.
    """
    try:
        tables = tomllib.loads(text)
        _check(tables)
    except (ValueError, RecursionError) as error:
        raise TomlError(str(error)) from None
    return tables


def _check(value: Any) -> None:
    if isinstance(value, dict):
        for one in value.values():
            _check(one)
    elif isinstance(value, list):
        for one in value:
            _check(one)
    elif isinstance(value, int) and not -_LARGEST <= value < _LARGEST:
        raise ValueError(f"an integer of {value.bit_length()} bits and a sign, where TOML has 63")
