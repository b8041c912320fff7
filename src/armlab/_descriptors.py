"""File descriptors that other code in this process may close: `os.closerange` closes by number, whoever opened them."""

from __future__ import annotations

import fcntl
import os

_APART = 512  # below the usual limit of 1024


class Descriptor:
    """An open descriptor, remembered with its file: once closed, its number may belong to another file."""

    def __init__(self, number: int) -> None:
        self.number = number
        self._file = _file(number)

    @property
    def is_open(self) -> bool:
        """Whether the number still belongs to the file."""
        return self._file is not None and _file(self.number) == self._file

    def same_file(self, number: int) -> bool:
        """Return whether another descriptor is of the same file."""
        return self._file is not None and _file(number) == self._file

    def close(self) -> None:
        """Close the descriptor, unless its number belongs to another file. A second call does nothing."""
        if self.is_open:
            os.close(self.number)
        self._file = None


def _file(number: int) -> tuple[int, int] | None:
    """Return device and inode of an open file."""
    try:
        about = os.fstat(number)
    except OSError:
        return None
    return about.st_dev, about.st_ino


def apart(number: int) -> int:
    """Move a newly opened descriptor to a high number, which no other code uses for a file closed before.

    The old number is closed, unless the system has no such number.
    """
    try:
        moved = fcntl.fcntl(number, fcntl.F_DUPFD_CLOEXEC, _APART)
    except OSError:
        return number
    os.close(number)
    return moved
