"""Other clocks: `resample`, `join`, `concat`, `shifted`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armlab.errors import ShapeError, UnknownName
from armlab.lie import quaternion, se3, so3
from armlab.log import Column, Table, concat
from armlab.log.table import join, resample

WALL = 1_700_000_000_000_000_000


def ramp(rows: int = 101, rate: float = 100.0, t0_ns: int = 0) -> Table:
    """Everything moves at constant speed, so interpolation must be exact."""
    t = np.arange(rows) / rate
    w, v = np.array([0.3, -0.4, 0.5]), np.array([1.0, 2.0, 3.0])
    T = se3.from_rp(so3.exp(t[:, None] * w), t[:, None] * v)
    return Table(
        t,
        {
            "q": np.stack([t, -2 * t], axis=1),
            "T_base_tool": T,
            "quat": quaternion.from_matrix(T[:, :3, :3]),
            "seq": np.arange(rows),
            "late": np.arange(rows) % 2 == 1,
            "word": np.array([f"w{i}" for i in range(rows)]),
        },
        {"quat": Column(unit="1", kind="quaternion"), "word": Column(unit="1", kind="text")},
        t0_ns=t0_ns,
    )


@settings(max_examples=40)
@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=30, unique=True))
def test_motion_at_constant_speed_is_exact_at_any_time(times: list[float]) -> None:
    t = np.sort(np.array(times))
    table = ramp()
    if len(t) > 1 and (np.diff(t) <= 0).any():
        return
    try:
        found = resample(table, t)
    except ShapeError as error:
        assert "signals.lowpass_offline" in str(error)  # noqa: PT017
        return
    w, v = np.array([0.3, -0.4, 0.5]), np.array([1.0, 2.0, 3.0])
    assert found["q"] == pytest.approx(np.stack([t, -2 * t], axis=1), abs=1e-12)
    assert found["T_base_tool"] == pytest.approx(se3.from_rp(so3.exp(t[:, None] * w), t[:, None] * v), abs=1e-9)
    turned = quaternion.to_matrix(found["quat"])
    assert turned == pytest.approx(found["T_base_tool"][:, :3, :3], abs=1e-9)
    last = np.searchsorted(table.t, t, side="right") - 1
    assert np.array_equal(found["seq"], last)
    assert np.array_equal(found["late"], last % 2 == 1)
    assert found["word"].tolist() == [f"w{i}" for i in last]


def test_resampling_at_the_same_times_changes_nothing() -> None:
    table = ramp()
    same = table.resample(table.t)
    assert same.sha256 == table.sha256
    assert "resample" in same.source[-1]


def test_rates() -> None:
    table = ramp()
    assert len(table.resample(1000.0)) == 1001
    assert table.resample(1000.0).t[-1] == table.t[-1]
    with pytest.raises(ShapeError, match=r"at least 100 Hz, got 50 Hz.*signals\.lowpass_offline"):
        table.resample(50.0)
    for rate in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(ShapeError, match="rate above zero"):
            table.resample(rate)
    for rate in (1e9, 1e308):
        with pytest.raises(ShapeError, match=r"got 1e\+\d+ Hz over 1 s: \S+ rows of 101\. Give the rate in hertz"):
            table.resample(rate)
    with pytest.raises(ShapeError, match="t in seconds"):
        replace(table, t=1e9 * table.t).resample(100.0)


def test_no_extrapolation() -> None:
    with pytest.raises(ShapeError, match=r"between 0 and 1 s, got 1\.01 s in row 1: no extrapolation"):
        ramp().resample(np.array([0.5, 1.01]))
    with pytest.raises(ShapeError, match="two rows"):
        ramp(1).resample(100.0)


def test_gaps_are_not_bridged() -> None:
    table = ramp().rows(np.array([*range(20), *range(40, 101)]))
    found = table.resample(200.0)
    gap = (found.t > 0.19 + 1e-9) & (found.t < 0.4 - 1e-9)
    assert np.all(np.isnan(found["q"][gap]))
    assert not np.isnan(found["q"][~gap]).any()
    assert found.columns["seq"].kind == "real"
    assert any("seq" in note for note in found.notes)
    assert np.all(found["word"][gap] == "")
    assert not np.isnan(table.resample(200.0, max_gap=0.5)["q"]).any()


def test_nan_stays_nan_and_spoils_only_its_neighbours() -> None:
    table = ramp()
    q = table["q"].copy()
    q[50] = np.nan
    found = table.with_column("q", q).resample(200.0)
    missing = np.flatnonzero(np.isnan(found["q"]).any(axis=1))
    assert missing.tolist() == [99, 100, 101]


def test_joining_holds_the_last_row_and_tells_its_age() -> None:
    left = ramp(t0_ns=WALL)
    right = Table(
        [0.0, 0.1, 0.5], {"wrench": np.arange(18.0).reshape(3, 6), "tick": [5, 6, 7]}, t0_ns=WALL + 200_000_000
    )
    found = left.join(right)
    early = left.t < 0.2 - 1e-9
    assert np.all(np.isnan(found["wrench"][early]))
    assert np.all(np.isnan(found["wrench_age"][early]))
    row = 45  # 0.45 s on the left clock is 0.25 s on the right
    assert np.array_equal(found["wrench"][row], right["wrench"][1])
    assert found["wrench_age"][row] == pytest.approx(0.15)
    assert found["tick"][row] == 6
    assert found.columns["tick"].kind == "real"
    assert found.units["wrench_age"] == "s"
    old = left.join(right, max_age=0.1)
    assert np.isnan(old["wrench"][row]).all()
    assert np.array_equal(old["wrench"][35], right["wrench"][1])


def test_joining_linearly() -> None:
    left, right = ramp(), Table([0.0, 1.0], {"grip": [0.0, 10.0]}, {"grip": Column(unit="N")})
    assert left.join(right, fill="linear")["grip"] == pytest.approx(10 * left.t)
    assert np.isnan(left.join(right, fill="linear", max_age=0.5)["grip"][1:-1]).all()
    with pytest.raises(UnknownName, match=r"'cubic'.*hold, linear"):
        join(left, right, fill="cubic")
    with pytest.raises(ShapeError, match="q in both"):
        left.join(left.select("q"))


def test_concatenation_keeps_the_gap() -> None:
    first, second = ramp(t0_ns=WALL), ramp(t0_ns=WALL + 5_000_000_000)
    both = concat(first, second)
    assert len(both) == 202
    assert both.t[101] == pytest.approx(5.0)
    assert np.array_equal(both["q"][101:], second["q"])
    assert concat(first).sha256 == first.sha256
    by_hand = concat(ramp(), ramp().shifted(2.0))
    assert by_hand.t[101] == pytest.approx(2.0)


def test_concatenation_refuses_what_does_not_fit() -> None:
    table = ramp()
    with pytest.raises(ShapeError, match=r"begin after 1 s, got 0 s; use shifted"):
        concat(table, table)
    with pytest.raises(ShapeError, match="differ in q"):
        concat(table, table.without("q").shifted(2.0))
    with pytest.raises(ShapeError, match="at least one"):
        concat()
