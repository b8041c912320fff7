"""The file beside a CSV file: of which columns it speaks, and what is done when it does not fit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from armlab.errors import LogError
from armlab.log import Column, Table, read, write
from armlab.log.file_formats.delimited import describe, read_sidecar, sidecar_path
from armlab.log.file_formats.description import Description


@pytest.fixture
def path(tmp_path: Path) -> Path:
    values = {"q": np.ones((3, 2)), "n": np.arange(3)}
    return write(Table([0.0, 0.1, 0.2], values, {"n": Column(unit="1", kind="count")}), tmp_path / "run.csv")


def test_what_is_written_is_read(path: Path) -> None:
    assert sidecar_path(path).name == "run.csv.toml"
    beside = read_sidecar(path)
    assert isinstance(beside, Description)
    assert beside.labels() == ["t [s]", "q1 [rad]", "q2 [rad]", "n"]
    assert beside.described()["n"].kind == "count"
    assert describe(read(path)).startswith("armlab = ")
    assert read_sidecar(path.with_name("other.csv")) is None


def test_one_that_speaks_of_other_columns_is_not_used(path: Path) -> None:
    path.write_text("t [s],q1 [rad]\n0,1\n0.1,2\n")
    table = read(path)
    assert table["q"].tolist() == [[1.0], [2.0]]
    assert "run.csv.toml describes other columns and is not used" in table.notes


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('kind = "count"', 'kind = "number"', "kind of column"),
        ('kind = "count"', "kind = 3", r"Expected `str`, got `int`"),
        ('clock = "file"', 'clok = "file"', "unknown field `clok`"),
        ("shape = []", "shape = [", "run.csv.toml"),
        ("shape = []", "shape = [1000000, 1000000]", "at most 1048576 numbers"),
        ("shape = []", "shape = [-1]", "sizes from 0"),
    ],
)
def test_damaged_ones_are_one_sentence(path: Path, old: str, new: str, words: str) -> None:
    beside = sidecar_path(path)
    text = beside.read_text(encoding="utf-8")
    assert old in text
    beside.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(LogError, match=words) as told:
        read(path)
    assert str(told.value).endswith(".")


def test_cells_that_are_no_numbers(path: Path) -> None:
    path.write_text(path.read_text(encoding="utf-8").replace("0.2,1.0,1.0,2", "0.2,1.0,1.0,2.5"), encoding="utf-8")
    with pytest.raises(LogError, match=r"columns that are described in .*run\.csv, got others: .*'n' of kind count"):
        read(path)
