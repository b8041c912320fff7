"""Tables as text."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.log import Column, Table
from armlab.log.table import component_names, describe_text, statistics, table_text, timing


def test_statistics_leave_out_what_is_missing() -> None:
    array = np.array([[1.0, np.nan], [3.0, np.nan], [np.nan, np.nan]])
    found = statistics(array)
    assert found["min"][0] == 1.0
    assert found["max"][0] == 3.0
    assert found["mean"][0] == 2.0
    assert found["sigma"][0] == 1.0
    assert found["missing"].tolist() == [1.0, 3.0]
    for key in ("min", "max", "mean", "sigma"):
        assert np.isnan(found[key][1])
    words = statistics(np.array(["a", ""]))
    assert words["missing"].tolist() == [1.0]
    assert np.isnan(words["min"]).all()


def test_timing() -> None:
    found = timing(Table([0.0, 0.1, 0.2, 0.6], {}))
    assert found["rows"] == 4
    assert found["duration"] == pytest.approx(0.6)
    assert found["rate"] == pytest.approx(10.0)
    assert found["gap"] == pytest.approx(0.4)
    assert timing(Table([0.0], {}))["duration"] == 0.0


def test_components_are_named_by_joint_or_number() -> None:
    table = Table(
        [0.0], {"q": [[1.0, 2.0]], "wrench_hat_cov": np.zeros((1, 6, 6)), "seq": [1]}, {"q": Column(labels=("a", "b"))}
    )
    assert component_names(table, "q") == ["q[a]", "q[b]"]
    assert component_names(table, "wrench_hat_cov")[7] == "wrench_hat_cov[2,2]"
    assert component_names(table, "seq") == ["seq"]


def test_texts() -> None:
    table = Table([0.0, 0.004], {"tau": [[1.0], [np.nan]]}, notes=("cut short",))
    assert table_text(table).splitlines()[2].split() == ["tau", "(2,", "1)", "N", "m", "1", "rows", "from", "row", "1"]
    assert table_text(table).endswith("note: cut short")
    assert describe_text(table).splitlines()[1].split() == ["tau[1]", "N", "m", "1", "1", "1", "0", "1"]
