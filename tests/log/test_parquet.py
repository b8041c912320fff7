"""Tables in Parquet."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from armlab import log
from armlab.errors import LogError, MissingExtra, UnknownName
from armlab.log import Column, Table
from armlab.log.file_formats.hdf5_parquet import read_parquet, write_parquet

pa = pytest.importorskip("pyarrow", reason="Parquet needs the extra data")
pq = pytest.importorskip("pyarrow.parquet")
T = np.arange(4) * 0.004


@pytest.fixture
def table() -> Table:
    values = {"q": np.arange(8.0).reshape(4, 2), "wrench_hat": np.ones((4, 6)), "q1": np.arange(4) + 2**60}
    values["mode"] = np.array(["on", "", "grå", "x"])
    columns = {"q1": Column(unit="1", kind="count"), "mode": Column(unit="1", kind="text")}
    return Table(T, values, columns, source=("here",))


def test_what_another_program_sees(table: Table, tmp_path: Path) -> None:
    path = log.write(table, tmp_path / "run.parquet")
    found = pq.read_table(path)
    assert found.column_names == ["t", "q1", "q2", *(f"wrench_hat{k}" for k in range(1, 7)), "q1_2", "mode"]
    assert {found.field(name).metadata[b"unit"] for name in ("q1", "q2")} == {b"rad"}
    assert found.field("wrench_hat4").metadata[b"unit"] == b"N m"
    assert found.column("q1_2").to_pylist() == table["q1"].tolist()
    assert found.column("mode").to_pylist() == ["on", "", "grå", "x"]
    chunk = pq.ParquetFile(path).metadata.row_group(0).column(1)
    assert chunk.compression == "ZSTD"
    assert set(chunk.encodings) == {"RLE", "BYTE_STREAM_SPLIT"}  # RLE: levels, of which there is one
    assert not chunk.has_dictionary_page
    assert callable(write_parquet)


def test_single_columns(table: Table, tmp_path: Path) -> None:
    path = log.write(table, tmp_path / "run.parquet")
    assert read_parquet(path, ["q1"])["q1"].tolist() == table["q1"].tolist()
    assert log.read(path, ["mode", "q"]).names == ("mode", "q")
    with pytest.raises(UnknownName, match="'qd'"):
        log.read(path, ["qd"])


def test_more_than_one_group_of_rows(table: Table, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("armlab.log.file_formats.hdf5_parquet.ROWS", 3)
    path = log.write(table, tmp_path / "run.parquet")
    assert pq.ParquetFile(path).num_row_groups == 2
    assert log.read(path).sha256 == table.sha256


def test_a_table_of_another_program(tmp_path: Path) -> None:
    path = tmp_path / "run.parquet"
    found = pa.table(
        {
            "time": pa.array([10**18, 10**18 + 4 * 10**6], pa.timestamp("ns")),
            "q1 [deg]": [180.0, None],
            "q2 [deg]": [0.0, 90.0],
            "count": [2**60 + 1, 2**60 + 2],
            "on": [True, False],
            "mode": ["a", None],
            "list": [[1], [2]],
        }
    )
    pq.write_table(found, path)
    table = log.read(path)
    assert table.t.tolist() == [0.0, 0.004]
    np.testing.assert_allclose(table["q"], [[np.pi, 0.0], [np.nan, np.pi / 2]])
    assert table["count"].tolist() == [2**60 + 1, 2**60 + 2]
    assert table["mode"].tolist() == ["a", ""]
    assert table["on"].tolist() == [1, 0]
    assert table.notes == ("left out: list (list<element: int64>)",)
    pq.write_table(found.select(["count"]), path)
    with pytest.raises(LogError, match=r"Expected a column t \[s\] in .*got count"):
        log.read(path)


def test_damaged_files(table: Table, tmp_path: Path, read_spoilt: Callable[..., None]) -> None:
    path = log.write(table, tmp_path / "run.parquet")
    read_spoilt(path, path, 60)
    path.write_bytes(path.read_bytes()[:50])
    with pytest.raises(LogError, match="a whole Parquet file"):
        log.read(path)


def test_without_pyarrow(table: Table, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = log.write(table, tmp_path / "run.parquet")
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    for job in (lambda: log.read(path), lambda: log.write(table, tmp_path / "again.parquet")):
        with pytest.raises(MissingExtra, match=r"Expected pyarrow .*pip install 'armlab\[data\]'"):
            job()
    assert [entry.name for entry in tmp_path.iterdir()] == ["run.parquet"]
