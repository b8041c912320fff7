"""Hashes of tables and files."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

from armlab.log import Column, Table
from armlab.log.file_formats.opening import file_hash, origin
from armlab.log.table import table_hash


def test_the_hash_of_a_table_never_changes_between_versions() -> None:
    """Model files refer to it: a new value here breaks every model file's link to its log."""
    table = Table([0.0, 0.5], {"q": [[1.0], [np.nan]], "seq": [1, 2]}, {})
    assert table_hash(table) == "164643750a016c3d86447c5228ca174c0140b35bf7485e8e5c888912c09129b0"


def test_every_nan_is_the_same_nan_and_text_has_no_padding() -> None:
    odd = np.array([0x7FF8000000000001, 0], dtype=np.uint64).view(float)
    about = {"x": Column(unit="1"), "w": Column(unit="1", kind="text")}
    a = Table([0.0, 1.0], {"x": odd, "w": np.array(["a", "b"], dtype="U9")}, about)
    b = Table([0.0, 1.0], {"x": [np.nan, 0.0], "w": np.array(["a", "b"])}, about)
    assert table_hash(a) == table_hash(b)
    assert table_hash(a) != table_hash(b.with_column("w", np.array(["a", "c"]), unit="1", kind="text"))


def test_file_hash(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"armlab" * 1000)
    assert file_hash(path) == hashlib.sha256(b"armlab" * 1000).hexdigest()
    assert origin(path) == f"file sha256 {file_hash(path)}"


def test_the_hash_of_a_folder_counts_names_and_contents(tmp_path: Path) -> None:
    found = set()
    for name, text in (("a", "x"), ("a", "y"), ("b", "y")):
        (tmp_path / name).write_text(text)
        found.add(origin(tmp_path))
        (tmp_path / name).unlink()
    assert len(found) == 3
    assert all(one.startswith(f"{tmp_path.name} sha256 ") for one in found)
