"""Text is written block by block, by pyarrow or without; both read back the same, both ways."""

from __future__ import annotations

import io
import sys
from pathlib import Path

import numpy as np
import pytest

from armlab import log
from armlab.errors import LogError
from armlab.log import Column, Table
from armlab.log.delimited_writing import write_csv

WORDS = ["", "1", 'a "b", c', "line\nbreak", "\r", "ü", " x "]


@pytest.fixture
def table() -> Table:
    """More rows than two blocks."""
    rng = np.random.default_rng(2)
    n = 25_000
    real = rng.normal(size=(n, 3)) * 10.0 ** rng.integers(-300, 300, (n, 3))
    real[rng.integers(0, n, 99), 1] = np.nan
    real[:4, 0] = [np.inf, -np.inf, -0.0, 5e-324]
    found = {"reals": real, "id": rng.integers(-(2**63), 2**63 - 1, n), "on": rng.integers(0, 2, n).astype(bool)}
    found["mode"] = np.array(WORDS)[rng.integers(0, len(WORDS), n)]
    kinds = {"reals": "real", "id": "count", "on": "flag", "mode": "text"}
    return Table(np.arange(n) / 3, found, {name: Column(unit="1", kind=kind) for name, kind in kinds.items()})


@pytest.mark.parametrize("writer", ["pyarrow", "slow"])
@pytest.mark.parametrize("reader", ["pyarrow", "slow"])
def test_with_and_without_pyarrow(
    table: Table, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, writer, reader
) -> None:
    if "pyarrow" in (writer, reader):
        pytest.importorskip("pyarrow")
    monkeypatch.setattr("armlab.log.delimited_writing.MANY", 1 if writer == "pyarrow" else 10**9)
    monkeypatch.setattr("armlab.log.delimited.LONG", 1 if reader == "pyarrow" else 10**9)
    path = log.write(table, tmp_path / "run.csv")
    assert log.read(path).sha256 == table.sha256


def test_without_pyarrow_at_all(table: Table, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("armlab.log.delimited_writing.MANY", 1)
    monkeypatch.setattr("armlab.log.delimited.LONG", 1)
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    few = table.rows(slice(100))
    assert log.read(log.write(few, tmp_path / "run.csv")).sha256 == few.sha256


def test_what_is_in_the_text() -> None:
    values = {"q": [[0.1, np.nan], [1e300, -0.0]], "on": [True, False], "say": np.array(['a "b"', ""])}
    columns = {"on": Column(unit="1", kind="flag"), "say": Column(unit="1", kind="text")}
    file, told = io.BytesIO(), []
    write_csv(Table([0.0, 1e-9], values, columns), file, lambda *one: told.append(one))
    assert file.getvalue() == b't [s],q1 [rad],q2 [rad],on,say\n0.0,0.1,,1,"a ""b"""\n1e-09,1e+300,-0.0,0,""\n'
    assert told == [(2, 2, "rows")]
    none = io.BytesIO()
    write_csv(Table([], {"q": np.zeros((0, 1)), "a,b": []}, {"a,b": Column(unit="N")}), none, lambda *_: None)
    assert none.getvalue() == b't [s],q1 [rad],"a,b [N]"\n'


def test_a_long_file_with_a_broken_line_is_named_by_the_line(table: Table, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("armlab.log.delimited.LONG", 1)
    path = log.write(table.select("id").rows(slice(50)), tmp_path / "run.csv")
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:20], lines[20] + ",7", *lines[21:]]) + "\n")
    with pytest.raises(LogError, match=r"Expected 2 fields .*line 21 "):
        log.read(path)
    path.write_text("\n".join([*lines[:20], lines[20] + "x", *lines[21:]]) + "\n")
    with pytest.raises(LogError, match=r"columns that run\.csv\.toml describes"):
        log.read(path)
