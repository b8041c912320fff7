"""Arrays of other programs: the old tools' names, one sample per row or per column."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from armlab.errors import LogError
from armlab.log.file_formats.column_labels import foreign_table

T = np.arange(5) * 0.004


@pytest.fixture
def path(tmp_path: Path) -> Path:
    (tmp_path / "run.x").write_text("anything")
    return tmp_path / "run.x"


def test_a_log_of_the_ancestors(path: Path) -> None:
    """Fields of Robotlab.jl, one sample per column, as its matrices are; what has another size is named."""
    q = np.arange(35.0).reshape(5, 7)
    arrays = {"timestamp": T[None], "pos": q.T, "trq_o": q.T, "seqnum": np.arange(5)[None], "GR": np.eye(7)}
    table = foreign_table(path, {name: (array, "") for name, array in arrays.items()}, ["Log"])
    np.testing.assert_array_equal(table.t, T)
    np.testing.assert_array_equal(table["q"], q)
    assert set(table.names) == {"q", "tau_ref", "seq"}
    assert table["seq"].dtype == np.int64
    assert table.notes == ("left out: Log, GR (7, 7)",)


def test_samples_in_rows_stay(path: Path) -> None:
    square = np.arange(25.0).reshape(5, 5)
    arrays = {"t": (T[:, None], "s"), "q": (square, "deg"), "T": (np.zeros((5, 4, 4)), ""), "x": (T[:, None], "")}
    table = foreign_table(path, arrays)
    np.testing.assert_allclose(table["q"], np.deg2rad(square))
    assert (table["T"].shape, table["x"].shape) == ((5, 4, 4), (5,))


def test_without_a_clock(path: Path) -> None:
    with pytest.raises(LogError, match=r"Expected times t, time or timestamp in .*, got q \(5, 7\), t \(2, 3\)\. Read"):
        foreign_table(path, {"q": (np.zeros((5, 7)), ""), "t": (np.zeros((2, 3)), "")})
    with pytest.raises(LogError, match=r"got none\."):
        foreign_table(path, {})
