"""Hashes of tables and files: the link from a model file back to its data."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    pass


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
