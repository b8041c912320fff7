"""Atomic file writes, descriptors that survive `os.closerange` in other code, and TOML parsing with size limits."""

from __future__ import annotations

import fcntl
import os
import re
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

_APART = 512  # lowest high number; below the usual limit of 1024


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a temporary path, which is atomically renamed to `path` on success and deleted on failure.

    Every OSError names `path`, unlike errors from plain writes.
    """
    part = path.with_name(f"{path.name}.part")
    try:
        yield part
        part.replace(path)
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), str(path)) from error
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)


class Descriptor:
    """Open file descriptor with the identity of its file, because a closed descriptor number may be reused for another
    file."""

    def __init__(self, number: int) -> None:
        self.number = number
        self._file = _file(number)

    @property
    def is_open(self) -> bool:
        """Whether the descriptor number still refers to the same file."""
        return self._file is not None and _file(self.number) == self._file

    def same_file(self, number: int) -> bool:
        """Return whether another descriptor refers to the same file."""
        return self._file is not None and _file(number) == self._file

    def close(self) -> None:
        """Close the descriptor unless its number now refers to another file; a second call has no effect."""
        if self.is_open:
            os.close(self.number)
        self._file = None


def _file(number: int) -> tuple[int, int] | None:
    """Return the device and inode of an open descriptor, or None if it is closed."""
    try:
        about = os.fstat(number)
    except OSError:
        return None
    return about.st_dev, about.st_ino


def apart(number: int) -> int:
    """Move a new descriptor to a high number, which other code is unlikely to confuse with an old descriptor; return
    the number.

    If no high number is available, the descriptor keeps its number.
    """
    try:
        moved = fcntl.fcntl(number, fcntl.F_DUPFD_CLOEXEC, _APART)
    except OSError:
        return number
    os.close(number)
    return moved


_LARGEST = 2**63
_LONGEST = 1 << 24  # characters; a robot file has 5 kB, a motion with its covariance 2 MB
_MOST = 10_000  # keys and tables; parsing one takes up to 0.3 ms
_MOST_VALUES = 1 << 20  # array values in total; parsing one takes 3 us
_DEEPEST = 16  # names in a dotted key; parsing time is quadratic in this number
_QUOTED = re.compile(
    r'"""(?:[^"\\]|\\.|"(?!""))*+(?:"{3,5})?|\'\'\'.*?(?:\'{3,5}|\Z)|"(?:[^"\\\n]|\\.)*+"?|\'[^\'\n]*+\'?|#[^\n]*+',
    re.DOTALL,
)
_TABLE = re.compile(r"^[ \t]*+\[", re.MULTILINE)
_DEEP = re.compile(rf"(?<![\w-])(?:[\w-]++[ \t]*+\.[ \t]*+){{{_DEEPEST}}}")


class TomlError(ValueError):
    """Invalid TOML text."""


def parsed(text: str) -> dict[str, Any]:
    """Parse a TOML text; raise TomlError if it is invalid or exceeds a size limit.

    Python's parser accepts integers of any length, nests up to Python's recursion limit, and takes quadratic time for
    dotted keys. This function therefore limits integers to 64 bits, dotted keys to 16 names, the text to 16 MiB, keys
    and tables to 10 000, and array values to 2^20.
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
    if isinstance(value, dict | list):
        for item in value.values() if isinstance(value, dict) else value:
            _check(item)
    elif isinstance(value, int) and not -_LARGEST <= value < _LARGEST:
        raise ValueError(f"an integer of {value.bit_length()} bits plus sign, although TOML allows 63")
