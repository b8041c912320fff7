"""Text is written block by block and comes back the same."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest

from armlab import log
from armlab.errors import LogError
from armlab.log import Column, Table
from armlab.log.file_formats.delimited import write_csv

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


@pytest.mark.parametrize("names", [("reals",), ("id", "on"), ("reals", "id", "on", "mode")])
def test_more_than_one_block_comes_back(table: Table, tmp_path: Path, names: tuple[str, ...]) -> None:
    kept = table.select(*names)
    assert log.read(log.write(kept, tmp_path / "run.csv")).sha256 == kept.sha256


def test_what_is_in_the_text() -> None:
    values = {"q": [[0.1, np.nan], [1e300, -0.0]], "on": [True, False], "say": np.array(['a "b"', ""])}
    columns = {"on": Column(unit="1", kind="flag"), "say": Column(unit="1", kind="text")}
    file, told = io.BytesIO(), []
    write_csv(Table([0.0, 1e-9], values, columns), file, lambda *one: told.append(one))
    assert file.getvalue() == b't [s],q1 [rad],q2 [rad],on,say\n0.0,0.1,,1,"a ""b"""\n1e-9,1e300,-0.0,0,""\n'
    assert told == [(2, 2, "rows")]
    none = io.BytesIO()
    write_csv(Table([], {"q": np.zeros((0, 1)), "a,b": []}, {"a,b": Column(unit="N")}), none, lambda *_: None)
    assert none.getvalue() == b't [s],q1 [rad],"a,b [N]"\n'


def test_a_broken_line_is_named(table: Table, tmp_path: Path) -> None:
    path = log.write(table.select("id").rows(slice(50)), tmp_path / "run.csv")
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:20], lines[20] + ",7", *lines[21:]]) + "\n")
    with pytest.raises(LogError, match=r"Expected 2 fields .*line 21 "):
        log.read(path)
    path.write_text("\n".join([*lines[:20], lines[20] + "x", *lines[21:]]) + "\n")
    with pytest.raises(LogError, match=r"columns that run\.csv\.toml describes"):
        log.read(path)
