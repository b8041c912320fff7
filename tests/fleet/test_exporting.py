"""Many logs in another format: the same tables, and what does not read is skipped by name."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from armlab import fleet, log
from armlab.errors import ConfigError, LogError


def test_every_log_is_the_same_table_in_the_other_format(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "bad.parquet").write_bytes(b"PAR1 nonsense")
    with ThreadPoolExecutor(2) as pool:
        done = fleet.export([folder, tmp_path / "bad.parquet"], tmp_path / "out", ".csv", pool)
    assert list(done.skipped) == [str(tmp_path / "bad.parquet")]
    assert "Parquet" in done.skipped[str(tmp_path / "bad.parquet")]
    assert len(done.results) == 6
    for name, path in done.results.items():
        assert path.suffix == ".csv"
        assert log.read(path).sha256 == log.read(name).sha256


def test_a_recording_needs_its_robot(folder: Path, tmp_path: Path, short_arm) -> None:
    with pytest.raises(ConfigError, match="--robot"):
        fleet.export(folder, tmp_path, ".mcap")
    done = fleet.export(folder / "log0.parquet", tmp_path, ".mcap", robot=short_arm.robot)
    (path,) = done.results.values()
    np.testing.assert_array_equal(log.read(path)["q"], log.read(folder / "log0.parquet")["q"])


def test_nothing_but_nonsense_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "bad.mcap").write_bytes(b"nonsense")
    with pytest.raises(LogError, match="used among 1, got none"):
        fleet.export(tmp_path, tmp_path / "out", ".csv")
    assert not (tmp_path / "out").exists()
