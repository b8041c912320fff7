"""Columns with labels and units of other programs; whole files are in test_delimited.py."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from armlab.errors import LogError
from armlab.log.file_formats.column_labels import CLOCKS, labelled_table, names_of


@pytest.fixture
def path(tmp_path: Path) -> Path:
    (tmp_path / "run.x").write_text("anything")
    return tmp_path / "run.x"


def test_names_and_units_of_headings(path: Path) -> None:
    heads = ["t [ms]", "- q_1[deg]", "joint[2]", "a [b] [N]", "plain"]
    assert names_of(path, heads) == [("t", "ms"), ("q_1", "deg"), ("joint[2]", ""), ("a [b]", "N"), ("plain", "")]
    with pytest.raises(LogError, match=r"got 'q' twice"):
        names_of(path, ["q", "q [rad]"])
    with pytest.raises(LogError, match=r"a column without a name"):
        names_of(path, ["[rad]x", ""])


def test_units_arrays_and_kinds(path: Path) -> None:
    arrays = {
        "time": (np.array([10**18, 10**18 + 4_000_000]), "ns"),
        "q": (np.full((2, 2), 180), "deg"),
        "tau1": (np.array([1.0, 2.0]), ""),
        "tau2": (np.array([3.0, 4.0]), "mN m"),
        "id": (np.array([2**60 + 1, 2**60 + 2]), ""),
        "on": (np.array([True, False]), ""),
        "mode": (np.array(["a", "b"]), ""),
    }
    table = labelled_table(path, arrays, notes=["read"])
    assert CLOCKS == ("t", "time")
    assert table.t.tolist() == [0.0, 0.004]
    np.testing.assert_allclose(table["q"], np.pi)
    assert table["id"].tolist() == [2**60 + 1, 2**60 + 2]
    kinds = {name: column.kind for name, column in table.columns.items()}
    assert kinds == {"q": "angle", "tau": "real", "id": "count", "on": "flag", "mode": "text"}
    np.testing.assert_allclose(table["tau"], [[1.0, 0.003], [2.0, 0.004]])
    assert table.notes == ("read",)
    back = {"t": (np.array([1.0, 0.0, 2.0]), ""), "x": (np.arange(3.0), "")}
    with pytest.warns(UserWarning, match=r"1 rows dropped: their time does not advance \(row 1\)"):
        assert labelled_table(path, back)["x"].tolist() == [0.0, 2.0]
    assert labelled_table(path, back, raw=True)["x"].tolist() == [0.0, 1.0, 2.0]


def test_a_number_that_is_too_large_for_a_joint_is_a_label(path: Path) -> None:
    """Nobody lists all places up to it."""
    arrays = {"t": (np.array([0.0, 1.0]), ""), "q999999999999": (np.array([0.0, 1.0]), "")}
    assert labelled_table(path, arrays).names == ("q999999999999",)
