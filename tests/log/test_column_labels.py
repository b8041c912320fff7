"""Labels, units and arrays of other programs; descriptions of columns."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from armlab.errors import LogError
from armlab.log import Column, Table
from armlab.log.file_formats.description import (
    Description,
    distinct,
    foreign_table,
    labelled_table,
    of_json,
)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    (tmp_path / "run.x").write_text("anything")
    return tmp_path / "run.x"


def test_a_number_that_is_too_large_for_a_joint_is_a_label(path: Path) -> None:
    """Nobody lists all places up to it."""
    arrays = {"t": (np.array([0.0, 1.0]), ""), "q999999999999": (np.array([0.0, 1.0]), "")}
    assert labelled_table(path, arrays).names == ("q999999999999",)


T = np.arange(5) * 0.004


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


TABLE = Table(
    [0.0, 0.5],
    {"q": [[1.0, 2.0], [3.0, 4.0]], "n": [7, 8], "none": np.zeros((2, 0))},
    {"n": Column(unit="1", kind="count"), "none": Column(unit="m"), "q": Column(labels=("a", "b"))},
    t0_ns=5,
    clock="robot",
    notes=("a note",),
    source=("here",),
)


def test_a_description_goes_through_json(tmp_path: Path) -> None:
    path = tmp_path / "run.x"
    path.write_text("anything")
    about = of_json(Description.of(TABLE).json(more=[1]), path)
    assert about == Description.of(TABLE)
    assert about.labels() == ["t [s]", "q1 [rad]", "q2 [rad]", "n"]
    assert (
        Description.made(about.described(), armlab="1", t0_ns=0, clock="", notes=(), source=()).columns == about.columns
    )
    again = about.table(path, TABLE.t, dict(TABLE.values))
    assert again.sha256 == TABLE.sha256
    assert dict(again.columns) == dict(TABLE.columns)
    assert again.source[1:] == ("here",)
    with pytest.raises(LogError, match="columns that are described in"):
        about.table(path, TABLE.t, {"q": np.zeros((2, 3))})
    for text in ("", "[]", '{"armlab": 1}', '{"armlab": "1"}', b"\xff"):
        with pytest.raises(LogError, match=r"a description of the columns in .*Export the log again\."):
            of_json(text, path)


def test_distinct_names() -> None:
    """Those that need no change keep their names, whatever comes before them."""
    wanted = {"a.b": "a_b", "a:b": "a_b", "a_b": "a_b", "t": "t", "a_b_2": "a_b_2"}
    assert distinct(wanted, ["t"]) == {"a.b": "a_b_3", "a:b": "a_b_4", "a_b": "a_b", "t": "t_2", "a_b_2": "a_b_2"}
    assert list(distinct({0: "q1", 1: "q1"}).values()) == ["q1", "q1_2"]
