"""What is said of a table goes through JSON; components are taken apart and put together; names become distinct."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from armlab.errors import LogError
from armlab.log import Column, Table
from armlab.log.file_formats.description import (
    Description,
    Progress,
    components,
    distinct,
    headings,
    of_json,
    put_together,
)

TABLE = Table(
    [0.0, 0.5],
    {"q": [[1.0, 2.0], [3.0, 4.0]], "n": [7, 8], "none": np.zeros((2, 0))},
    {"n": Column(unit="1", kind="count"), "none": Column(unit="m"), "q": Column(labels=("a", "b"))},
    t0_ns=5,
    clock="robot",
    notes=("a note",),
    source=("here",),
)


def test_headings() -> None:
    assert list(headings("q", Column((2,), "rad"))) == ["q1 [rad]", "q2 [rad]"]
    assert list(headings("n", Column((), "1"))) == ["n"]
    assert list(headings("f", Column((6,), "N, N m")))[2:4] == ["f3 [N]", "f4 [N m]"]
    assert list(headings("c", Column((2, 2), "m")))[1] == "c1_2 [m]"


def test_a_description_goes_through_json(tmp_path: Path) -> None:
    path = tmp_path / "run.x"
    path.write_text("anything")
    about = of_json(Description.of(TABLE).json(more=[1]), path)
    assert about == Description.of(TABLE)
    assert about.labels() == ["t [s]", "q1 [rad]", "q2 [rad]", "n"]
    assert list(about.selected(["n", "q"]).columns) == ["q", "n"]
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


def test_components_and_back() -> None:
    parts = list(components(TABLE))
    assert [(label, unit) for label, unit, _ in parts] == [("t", "s"), ("q1", "rad"), ("q2", "rad"), ("n", "1")]
    values = put_together(Description.of(TABLE), [array for _, _, array in parts[1:]], 2)
    assert [array.shape for array in values.values()] == [(2, 2), (2, 1), (2, 0)]
    np.testing.assert_array_equal(values["q"], TABLE["q"])


def test_distinct_names() -> None:
    """Those that need no change keep their names, whatever comes before them."""
    wanted = {"a.b": "a_b", "a:b": "a_b", "a_b": "a_b", "t": "t", "a_b_2": "a_b_2"}
    assert distinct(wanted, ["t"]) == {"a.b": "a_b_3", "a:b": "a_b_4", "a_b": "a_b", "t": "t_2", "a_b_2": "a_b_2"}
    assert list(distinct({0: "q1", 1: "q1"}).values()) == ["q1", "q1_2"]


def test_progress_is_any_function_of_three() -> None:
    tell: Progress = lambda done, total, what: None  # noqa: E731
    tell(1, 2, "rows")
