"""Hashes of tables and files: the link from a model file back to its data."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from armlab.log.table import Table

__all__ = ["file_hash", "origin", "table_hash"]


def table_hash(table: Table) -> str:
    """Return the SHA-256 over `t` and, by name, unit, kind, type, shape and bytes of every column.

    Notes, source and clock do not count: the same data from two formats hash equal. Every NaN counts as the same NaN.
    """
    digest = hashlib.sha256(b"armlab table 1\n")
    digest.update(_bytes(table.t))
    for name in sorted(table.names):
        column, array = table.columns[name], table[name]
        kind = "text" if array.dtype.kind == "U" else array.dtype.str
        digest.update("\0".join([name, column.unit or "1", column.kind or "", kind, str(array.shape)]).encode())
        digest.update(_bytes(array))
    return digest.hexdigest()


def file_hash(path: str | Path) -> str:
    """Return the SHA-256 of a file's bytes."""
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def origin(path: str | Path) -> str:
    """Return the first entry of the source of a table: name of a file and its hash; of a folder, over its files."""
    path = Path(path)
    if not path.is_dir():
        return f"{path.name} sha256 {file_hash(path)}"
    files = [f"{one.name} {file_hash(one)}\n" for one in sorted(path.iterdir()) if one.is_file()]
    return f"{path.name} sha256 {hashlib.sha256(''.join(files).encode()).hexdigest()}"


def _bytes(array: np.ndarray) -> bytes | memoryview:
    """Return the bytes that count: text without padding, one pattern for NaN."""
    if array.dtype.kind == "U":
        return "\0".join(array.ravel().tolist()).encode()
    if array.dtype.kind == "f" and np.isnan(array).any():
        array = np.where(np.isnan(array), np.nan, array)
    return np.ascontiguousarray(array).reshape(-1).view(np.uint8).data
