"""Opening files: formats by first bytes, hashes, bounds, missing extras."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
import pytest

from armlab.errors import LogError, MissingExtra
from armlab.log import Column, Table
from armlab.log.file_formats.opening import (
    check_readable,
    check_unpacked_size,
    format_of,
    needed,
    origin,
)
from armlab.log.table import table_hash


@pytest.mark.parametrize(
    ("first", "name"),
    [
        (b"\x89MCAP0\r\nrest", "MCAP"),
        (b"SQLite format 3\0", "SQLite (rosbag2)"),
        (b"#ROSBAG V2.0\n", "ROS 1 bag"),
        (b"PAR1....", "Parquet"),
        (b"MATLAB 5.0 MAT-file", "MAT v5"),
        (b"MATLAB 7.3 MAT-file".ljust(512) + b"\x89HDF\r\n\x1a\n", "MAT v7.3"),
        (b"\x89HDF\r\n\x1a\n", "HDF5"),
        (b"Julia data file (HDF5), version 0.1.1".ljust(512, b"\0") + b"\x89HDF\r\n\x1a\n", "HDF5"),
        (b"t [s],mode\n0,\x01\n", "text"),
        (b"\x1f\x8b\x08", "gzip"),
        ("t [s],q1 [grå]\n".encode(), "text"),
        (b"\x00\x00\x00\x02\x00\x00\x00\x40", "LabComm"),
        (b"\x0bLabComm2013\x02", "LabComm"),
        (b"\x01\x10\x0eLabComm2014.v1", "LabComm"),
        (b"\x01LabComm", "unknown"),
        (b"\x00\x01", "unknown"),
        (b"", "empty"),
    ],
)
def test_formats(first: bytes, name: str) -> None:
    assert format_of(first) == name


def test_a_pipe_is_refused_not_waited_for(tmp_path: Path) -> None:
    path = tmp_path / "pipe"
    os.mkfifo(path)
    with pytest.raises(LogError, match="got a pipe"):
        check_readable(path)


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


def test_the_hash_of_a_folder_counts_names_and_contents(tmp_path: Path) -> None:
    found = set()
    for name, text in (("a", "x"), ("a", "y"), ("b", "y")):
        (tmp_path / name).write_text(text)
        found.add(origin(tmp_path))
        (tmp_path / name).unlink()
    assert len(found) == 3
    assert all(one.startswith(f"{tmp_path.name} sha256 ") for one in found)


def test_what_is_missing_is_named_with_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    with pytest.raises(MissingExtra, match=r"Expected pyarrow for Parquet, got none\. Install it: pip install 'armlab"):
        needed("pyarrow.parquet", "for Parquet")


def test_a_thousand_times_the_file(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    path.write_bytes(bytes(100_000))
    check_unpacked_size(path, 100_000_000)
    with pytest.raises(LogError, match=r"at most 100000000 bytes in .*a\.h5, 1000 times its size, got 100000001"):
        check_unpacked_size(path, 100_000_001)
    path.write_bytes(b"")
    check_unpacked_size(path, 1 << 26)
