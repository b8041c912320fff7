"""Formats are told by their first bytes."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from armlab.errors import LogError
from armlab.log.file_formats.opening import BAGS, FIRST, bag_files, check_readable, format_at, format_of, is_text


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
