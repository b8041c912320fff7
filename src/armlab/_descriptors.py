"""File descriptors that other code in this process may close: `os.closerange` closes by number, whoever opened it."""

from __future__ import annotations

import os

__all__ = ["identity"]


def identity(number: int) -> tuple[int, int] | None:
    """Return device and inode of the open file behind a descriptor, None when it is closed.

    Parameters
    ----------
    number : the descriptor. After it was closed it may belong to another file.
    """
    try:
        about = os.fstat(number)
    except OSError:
        return None
    return about.st_dev, about.st_ino
