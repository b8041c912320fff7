"""Bound on the size of what HDF5 and Parquet files unpack to, checked before it is read."""

from __future__ import annotations

from pathlib import Path

from armlab.errors import LogError

__all__ = ["check_unpacked_size"]

_ANY = 1 << 26  # bytes
_RATIO = 1000  # bytes for each of the file's own, above that: a column that never changes reaches it


def check_unpacked_size(path: Path, size: int) -> None:
    """Refuse a file whose arrays are far larger than itself.

    Parameters
    ----------
    path : of the file.
    size : bytes of its arrays, as the file states.

    Raises
    ------
    LogError : more than 64 MiB and 1000 times the file.
    """
    most = max(_ANY, _RATIO * path.stat().st_size)
    if size > most:
        raise LogError(
            f"Expected arrays of at most {most} bytes in {path}, {_RATIO} times its size, got {size}. If you trust it, "
            "write it without compression."
        )
