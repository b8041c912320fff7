"""Opening files: formats by first bytes, hashes, bounds, missing extras."""

from __future__ import annotations

import hashlib
import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest

from armlab.errors import LogError, MissingExtra
from armlab.log import Column, Table
from armlab.log.file_formats.opening import (
    BAGS,
    FIRST,
    bag_files,
    check_readable,
    check_unpacked_size,
    file_hash,
    format_at,
    format_of,
    is_text,
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


def test_only_mcap_is_read(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    path.write_bytes(b"PAR1")
    with pytest.raises(LogError, match=r"Expected a log in MCAP at .*log\.mcap, got a file of format Parquet"):
        check_readable(path)
    path.write_bytes(b"\x89MCAP0\r\n")
    check_readable(path)


def test_a_pipe_is_refused_not_waited_for(tmp_path: Path) -> None:
    path = tmp_path / "pipe"
    os.mkfifo(path)
    with pytest.raises(LogError, match="got a pipe"):
        check_readable(path)


def test_text_is_told_from_recordings(tmp_path: Path) -> None:
    path = tmp_path / "log"
    assert not is_text(path)
    for first, expected in ((b"t,q1\n", True), (b"\x1f\x8b\x08", True), (b"\x89MCAP0\r\n", False), (b"", False)):
        path.write_bytes(first)
        assert is_text(path) is expected


def test_the_format_of_a_path(tmp_path: Path) -> None:
    path = tmp_path / "log"
    assert format_at(path) == ""
    assert format_at(tmp_path) == ""
    for first, expected in ((b"\x0bLabComm2013\x02", "LabComm"), (b"t,q1\n", "text"), (b"", "empty")):
        path.write_bytes(first)
        assert format_at(path) == expected
    path.write_bytes(bytes(512) + b"\x89HDF\r\n\x1a\n" + bytes(FIRST))
    assert format_at(path) == "HDF5"
    (tmp_path / "metadata.yaml").touch()
    assert format_at(tmp_path) == "rosbag2"


def test_files_of_a_bag_without_metadata(tmp_path: Path) -> None:
    """A recorder that was killed leaves run/run_0.mcap and no metadata.yaml."""
    run = tmp_path / "run"
    run.mkdir()
    for name in ("run_10.mcap", "run_2.mcap", "other_1.mcap", "run_x.mcap", "run_1.txt"):
        (run / name).touch()
    assert [one.name for one in bag_files(run)] == ["run_2.mcap", "run_10.mcap"]
    assert format_at(run) in BAGS
    assert format_at(tmp_path) == ""


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


def test_what_is_installed_is_returned() -> None:
    assert needed("json", "for a test") is json


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
