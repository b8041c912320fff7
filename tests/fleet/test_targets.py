"""Files that many logs become: named as the logs, none replaced unasked, none lost to another of its name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from armlab.errors import ConfigError, ShapeError
from armlab.fleet.logs import targets
from armlab.log import Table


def test_files_stand_in_folders_as_the_logs_do(tmp_path: Path) -> None:
    jobs = {name: tmp_path / name for name in ("monday/a.mcap", "monday/b.csv", "tuesday/a.mcap")}
    found = targets(jobs, tmp_path / "new", ".csv", "_estimate")
    assert {str(path.relative_to(tmp_path / "new")) for path in found.values()} == {
        "monday/a_estimate.csv",
        "monday/b_estimate.csv",
        "tuesday/a_estimate.csv",
    }
    assert list(found) == list(jobs)


def test_one_log_stands_in_the_folder_itself(tmp_path: Path) -> None:
    assert targets({"a": tmp_path / "deep/a.mcap"}, tmp_path, ".mat") == {"a": tmp_path / "a.mat"}


def test_what_exists_is_kept_unless_forced(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t [s]\n")
    jobs = {"a": tmp_path / "logs/a.mcap", "b": tmp_path / "logs/b.mcap"}
    with pytest.raises(ConfigError, match=r"got 1 that exist, first .*a\.csv.*--force"):
        targets(jobs, tmp_path, ".csv")
    assert targets(jobs, tmp_path, ".csv", force=True)["a"] == tmp_path / "a.csv"


def test_what_cannot_be_named_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ShapeError, match="which would both be"):
        targets({"a": tmp_path / "a.mcap", "b": tmp_path / "a.csv"}, tmp_path / "new", ".mat")
    with pytest.raises(ShapeError, match="got a table"):
        targets({"a": Table(np.arange(3.0), {"q": np.zeros((3, 1))})}, tmp_path, ".mat")
    with pytest.raises(ConfigError, match=r"Expected a format among \.mcap"):
        targets({"a": tmp_path / "a.mcap"}, tmp_path, ".docx")


def test_a_log_is_never_replaced_by_what_it_becomes(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(b"rows")
    (tmp_path / "link").symlink_to(tmp_path)
    for folder in (tmp_path, tmp_path / "link"):
        with pytest.raises(ConfigError, match=r"got 1 that are read, first .*a\.mcap\. Name another folder or format"):
            targets({"a": tmp_path / "a.mcap"}, folder, ".mcap", force=True)
    assert targets({"a": tmp_path / "a.mcap"}, tmp_path, ".csv", force=True) == {"a": tmp_path / "a.csv"}
