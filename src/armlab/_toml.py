"""TOML of users: one error for everything that can be wrong with a text, and bounds before Python's parser sees it."""

from __future__ import annotations

import re
import tomllib
from typing import Any

_LARGEST = 2**63
_LONGEST = 1 << 24  # characters; a robot has 5 kB, a motion with its covariance 2 MB
_MOST = 10_000  # keys and tables, each of which takes the parser up to 0.3 ms
_MOST_VALUES = 1 << 20  # of all arrays, each of which takes it 3 us
_DEEPEST = 16  # names in a dotted key; the parser takes the square of it in time
_QUOTED = re.compile(
    r'"""(?:[^"\\]|\\.|"(?!""))*+(?:"{3,5})?|\'\'\'.*?(?:\'{3,5}|\Z)|"(?:[^"\\\n]|\\.)*+"?|\'[^\'\n]*+\'?|#[^\n]*+',
    re.DOTALL,
)
_TABLE = re.compile(r"^[ \t]*+\[", re.MULTILINE)
_DEEP = re.compile(rf"(?<![\w-])(?:[\w-]++[ \t]*+\.[ \t]*+){{{_DEEPEST}}}")


class TomlError(ValueError):
    """A text that is no TOML."""


def parsed(text: str) -> dict[str, Any]:
    """Return the tables of a TOML text; raise TomlError for invalid text and for text beyond the bounds.

    Python's parser accepts integers of any length, nests as deep as Python allows, and takes quadratic time for dotted
    keys: bounds are 64 bits, 16 names, 16 MiB, 50 000 keys and tables.
    """
    try:
        _check_size(text)
        tables = tomllib.loads(text)
        _check(tables)
    except (ValueError, RecursionError) as error:
        raise TomlError(str(error)) from None
    return tables


def _check_size(text: str) -> None:
    if len(text) > _LONGEST:
        raise ValueError(f"a text of {len(text)} characters, more than {_LONGEST}")
    statements = text.count("=") + len(_TABLE.findall(text))
    if statements > _MOST:
        raise ValueError(f"{statements} keys and tables, more than {_MOST}")
    values = text.count(",") + text.count("[")
    if values > _MOST_VALUES:
        raise ValueError(f"arrays of {values} values, more than {_MOST_VALUES}")
    if text.count(".") >= _DEEPEST and _DEEP.search(_QUOTED.sub("_", text)):
        raise ValueError(f"a dotted key of more than {_DEEPEST} names")


def _check(value: Any) -> None:
    if isinstance(value, dict):
        for one in value.values():
            _check(one)
    elif isinstance(value, list):
        for one in value:
            _check(one)
    elif isinstance(value, int) and not -_LARGEST <= value < _LARGEST:
        raise ValueError(f"an integer of {value.bit_length()} bits and a sign, where TOML has 63")
