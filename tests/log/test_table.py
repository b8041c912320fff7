"""Table and its columns: units, shapes, rows, hashes, states; other clocks."""

from __future__ import annotations

import contextlib
import math
import pickle
import sys
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armlab import glossary
from armlab.errors import LogError, MissingExtra, ShapeError, UnknownName
from armlab.lie import quaternion, se3, so3
from armlab.log import Column, Table, concat
from armlab.log.column import alias, refuse_ragged
from armlab.log.table import QD_SOURCES, TAU_SOURCES, component_names, missing_rows, statistics

WALL = 1_700_000_000_000_000_000


def example(rows: int = 50, joints: int = 7, seed: int = 1) -> Table:
    rng = np.random.default_rng(seed)
    values = {name: rng.normal(size=(rows, joints)) for name in ("q", "qd", "tau")}
    values |= {"seq": np.arange(rows) + 100, "grip": rng.normal(size=rows)}
    return Table(np.arange(rows) * 0.004, values, {"grip": Column(unit="N")}, t0_ns=WALL, clock="robot")


def test_known_names_take_unit_kind_and_frame_from_the_glossary() -> None:
    table = example()
    assert table.units == {"q": "rad", "qd": "rad/s", "tau": "N m", "seq": "1", "grip": "N"}
    assert (table.columns["q"].kind, table.columns["tau"].frame, table["seq"].dtype.str) == ("angle", "joint", "<i8")
    assert (table.names, len(table)) == (("q", "qd", "tau", "seq", "grip"), 50)
    assert "q" in table
    assert "nothing" not in table


def test_values_are_read_only_and_independent_of_the_callers_array() -> None:
    q = np.zeros((3, 2))
    view = q[:, :]
    view.flags.writeable = False
    table = Table([0.0, 1.0, 2.0], {"q": view})
    q[:] = 7.0
    assert np.all(table["q"] == 0.0)
    with pytest.raises(ValueError, match="read-only"):
        table["q"][0, 0] = 1.0
    with pytest.raises(AttributeError):
        table.t0_ns = 3  # type: ignore[misc]


@pytest.mark.parametrize(
    ("values", "columns", "message"),
    [
        ({"q": np.zeros((2, 7))}, {}, "Expected 3 rows in the column 'q'"),
        ({"q": np.zeros((3, 7)), "qd": np.zeros((3, 6))}, {}, "same number of joints"),
        ({"wrench": np.zeros((3, 5))}, {}, r"\(N, 6\) for the column 'wrench'.*\(N, 5\)"),
        ({"mine": np.zeros(3)}, {}, "Expected a unit for the column 'mine'"),
        ({"tau": np.zeros((3, 7))}, {"tau": Column(unit="Nm")}, "Expected unit 'N m'.*got 'Nm'"),
        ({"wrench": np.zeros((3, 6))}, {"wrench": Column(frame="sensor")}, "Expected frame 'base'"),
        ({"mine": np.zeros(3)}, {"mine": Column(unit="1", kind="odd")}, "kind of column"),
        ({"mine": np.zeros((3, 2))}, {"mine": Column(unit="1", labels=("a",))}, "Expected 2 labels"),
        ({"seq": [0.0, 0.5, 1.0]}, {}, "integers that fit int64"),
        ({"seq": [0.0, 2.0**70, 1.0]}, {}, "integers that fit int64"),
        ({"late": [0, 1, 2]}, {}, "integers that fit bool"),
        ({"dt": 1.0}, {}, "one value per row"),
        ({"q": [["a"], ["b"], ["c"]]}, {}, "Expected numbers"),
        ({}, {"q": Column()}, "only for columns with values"),
        ({"t": [0.0, 1.0, 2.0]}, {"t": Column(unit="s")}, "column names other than t, which is the table's clock"),
    ],
)
def test_wrong_columns_are_refused(values: dict, columns: dict, message: str) -> None:
    with pytest.raises((ShapeError, UnknownName), match=message):
        Table([0.0, 1.0, 2.0], values, columns)


def test_clock_must_be_finite_and_increase() -> None:
    wrong = {"row 2 after 1 s": [0.0, 1.0, 1.0], "row 2 after 2 s": [0.0, 2.0, 1.0], "nan in row 1": [0.0, np.nan, 1.0]}
    for message, t in {**wrong, r"got \(1, 3\)": [[0.0, 1.0, 2.0]]}.items():
        with pytest.raises(ShapeError, match=message):
            Table(t, {})


def test_rows_slices_are_views_and_masks_copies() -> None:
    table = example()
    half = table.between(0.04, 0.08)  # half open
    assert np.array_equal(half.t, table.t[10:20])
    assert (half.units, half.t0_ns, half.source) == (table.units, table.t0_ns, ("between(0.04, 0.08)",))
    part = table.rows(slice(10, 20))
    assert np.shares_memory(part["q"], table["q"])
    assert np.array_equal(part.t, table.t[10:20])
    mask = table["q"][:, 0] > 0
    some = table.where(mask)
    assert np.array_equal(some["qd"], table["qd"][mask])
    assert not np.shares_memory(some["q"], table["q"])
    assert np.array_equal(table.where(lambda tab: tab["q"][:, 0] > 0)["q"], some["q"])
    assert np.array_equal(table.rows(np.array([3, 7]))["seq"], [103, 107])
    assert table.rows(slice(None, None, 2))["q"].flags.c_contiguous
    with pytest.raises(ShapeError, match="mask of 50 rows"):
        table.rows(np.ones(3, dtype=bool))


def test_select_without_with_column_and_rename() -> None:
    table = example()
    assert table.select("tau", "q").names == ("tau", "q")
    assert table.without("q").names == ("qd", "tau", "seq", "grip")
    more = table.with_column("wrench", np.ones((50, 6)))
    assert more.units["wrench"] == "N, N m"
    renamed = table.rename({"grip": "pinch"})
    assert renamed.units["pinch"] == "N"
    for change, name in ((table.select, "nope"), (table.without, "nope"), (table.rename, {"nope": "x"})):
        with pytest.raises(UnknownName, match="Known: grip"):
            change(name)
    with pytest.raises(ShapeError, match="Expected a unit"):
        table.with_column("mine", np.ones(50))
    with pytest.raises(ShapeError, match="Expected unit"):
        table.rename({"grip": "qdd"})
    with pytest.raises(ShapeError, match="differ from other columns"):
        table.rename({"grip": "q"})


def test_matching_is_in_natural_order() -> None:
    names = [f"irb2ext.robot[0].joint[{i}].posRawAbs" for i in (10, 2, 1, 0)]
    values = {name: np.full(2, float(name.split("[")[2].split("]")[0])) for name in names}
    table = Table([0.0, 1.0], values, {name: Column(unit="rad") for name in names})
    assert np.array_equal(table.matching(r"robot_0.*posRawAbs"), [[0.0, 1.0, 2.0, 10.0]] * 2)
    assert np.array_equal(table.matching(r"joint\[2\]"), [[2.0]] * 2)
    assert alias(names[1]) == "irb2ext_robot_0__joint_2__posRawAbs"
    assert alias("sample:value[3]") == "sample_value_3"
    with pytest.raises(UnknownName, match="column that matches"):
        table.matching("velocity")


def test_missing_rows_are_found_dropped_and_left_out_of_statistics() -> None:
    table = example()
    tau = table["tau"].copy()
    tau[[4, 9], 2] = np.nan
    table = table.with_column("tau", tau)
    assert table.missing() == {"tau": (2, (4, 9))}
    assert np.flatnonzero(missing_rows(tau)).tolist() == [4, 9]
    assert missing_rows(np.array(["a", ""])).tolist() == [False, True]
    whole = table.dropna("tau")
    assert (len(whole), whole.missing()) == (48, {})
    assert "2 of 50 rows removed" in whole.notes[-1]
    assert len(table.dropna("q")) == 50
    found = statistics(np.array([[1.0, np.nan], [3.0, np.nan], [np.nan, np.nan]]))
    for key, value in {"min": 1.0, "max": 3.0, "mean": 2.0, "sigma": 1.0}.items():
        np.testing.assert_array_equal(found[key], [value, np.nan])
    assert found["missing"].tolist() == [1.0, 3.0]
    words = statistics(np.array(["a", ""]))
    assert words["missing"].tolist() == [1.0]
    assert np.isnan(words["min"]).all()


def test_states_carry_the_columns_and_nothing_else() -> None:
    table = example().with_column("session", np.repeat([1, 2], 25)).without("tau")
    states = list(table.states())
    state = states[3]
    assert np.array_equal(state.q, table["q"][3])
    assert (len(states), state.t, state.dt, state.seq, state.tau_source) == (50, table.t[3], table.dt[3], 103, "none")
    assert np.isnan([*state.tau, *state.wrench]).all()
    assert np.array_equal(states[20].q_start, table["q"][0])
    assert np.array_equal(states[30].q_start, table["q"][25])
    with pytest.raises(UnknownName, match="'q'"):
        table.without("q").states()
    values = {"q": np.zeros((2, 3)), "tau": np.zeros((2, 3)), "tau_source": [2, 0], "qd_source": [1, 0]}
    values |= {"session_t": [7.0, 0.5], "session": [1, 2], "robot_ns": [np.nan, 5.0], "utilization": [np.nan, 4.0]}
    table = Table([0.0, 1.0], values)
    first, second = table.states()
    assert (first.tau_source, second.tau_source) == (TAU_SOURCES[2], TAU_SOURCES[0]) == ("reference", "none")
    assert (first.qd_source, second.qd_source) == (QD_SOURCES[1], QD_SOURCES[0]) == ("measured", "difference")
    assert (first.t, second.t, first.robot_ns, second.robot_ns, second.utilization) == (7.0, 0.5, 0, 5, 4.0)
    assert np.isnan(first.utilization)
    assert first.q_sent.size == 0
    assert next(table.without("tau_source").states()).tau_source == "measured"


def test_dt_is_the_recorded_one_or_the_difference() -> None:
    table = example()
    assert table.dt[0] == pytest.approx(0.004)
    assert np.array_equal(table.dt[1:], np.diff(table.t))
    recorded = table.with_column("dt", np.full(50, 0.0041))
    assert np.all(recorded.dt == 0.0041)
    fewer = recorded.rows(np.array([0, 1, 2, 6, 7]))
    assert fewer.dt == pytest.approx([0.0041, 0.0041, 0.0041, 0.016, 0.0041])
    begun = recorded.with_column("session", np.repeat([1, 2], 25)).rows(np.array([0, 1, 2, 30, 31]))
    assert begun.dt[3] == 0.0041
    assert "dt" not in recorded.resample(500.0)
    assert recorded.resample(500.0).dt == pytest.approx(0.002)
    assert np.isnan(table.rows(slice(0, 1)).dt[0])
    assert Table([3.0], {"dt": [0.004]}).dt.tolist() == [0.004]
    assert Table([], {}).dt.size == 0
    assert Table([0.0, 1.0, 3.0], {"dt": [np.nan, 1.0, np.nan]}).dt.tolist() == [1.5, 1.0, 2.0]


def test_text_names_every_column_with_shape_unit_and_missing() -> None:
    table = example().with_column("tau", np.full((50, 7), np.nan))
    text = str(table)
    for words in ("50 rows", "250 Hz on the robot clock", "50 rows from row 0", *(f"\n{one} " for one in table.names)):
        assert words in text
    assert "q[7]" in table.describe()
    assert "Table 50 rows" in repr(table)
    page = mixed()._repr_html_()
    assert "Table of 2 rows" in page
    assert "<td>q</td><td>(2, 2)</td><td>rad</td><td>1</td><td>0.1 to 0.3</td>" in page
    assert Table([], {"grip": []}, {"grip": Column(unit="N")})._repr_html_().count("<tr>") == 2
    values = {"q": [[1.0, 2.0]], "wrench_hat_cov": np.zeros((1, 6, 6)), "seq": [1]}
    table = Table([0.0], values, {"q": Column(labels=("a", "b"))})
    assert component_names(table, "q") == ["q[a]", "q[b]"]
    assert component_names(table, "wrench_hat_cov")[7] == "wrench_hat_cov[2,2]"
    assert component_names(table, "seq") == ["seq"]


def test_hash_depends_on_data_only() -> None:
    table = example()
    assert table.sha256 == example().select("grip", "seq", "tau", "qd", "q").sha256
    assert table.sha256 == Table(table.t, table.values, table.columns, notes=("read elsewhere",)).sha256
    q = table["q"].copy()
    q[17, 3] = np.nextafter(q[17, 3], 9.0)
    for other in (
        table.with_column("q", q),
        table.rename({"grip": "pinch"}),
        table.shifted(1e-9),
        table.rows(slice(0, 49)),
        table.with_column("grip", table["grip"], unit="kg"),
    ):
        assert other.sha256 != table.sha256


def test_pickle_and_extreme_sizes() -> None:
    table = example()
    again = pickle.loads(pickle.dumps(table))
    assert (again.sha256, again.t0_ns) == (table.sha256, table.t0_ns)
    empty = table.rows(slice(0, 0))
    assert (len(empty), list(empty.states())) == (0, [])
    assert "0 rows" in str(empty)
    assert empty.describe()


@pytest.mark.parametrize(
    ("name", "values", "dtype"),
    [
        ("q", [[1, 2], [3, 4]], "<f8"),
        ("seq", [1.0, 2.0], "<i8"),
        ("late", [0, 1], "|b1"),
        ("dt", np.ones(2, dtype=np.float32), "<f8"),
        ("dt", np.ones(2, dtype=">f8"), "<f8"),
        ("late", [0.0, np.nan], "<f8"),
    ],
)
def test_stored_values_have_the_type_of_their_kind(name: str, values: list, dtype: str) -> None:
    table = Table([0.0, 1.0], {name: values})
    assert table[name].dtype.str == dtype
    if dtype == "<f8" and name == "late":
        assert table.columns[name].kind == "real"
        assert table.notes == ("late: stored as real because this flag column has missing values",)


def test_a_name_that_is_no_column_of_the_glossary_takes_the_unit_that_is_given() -> None:
    column = Table([0.0], {"x": [1.0]}, {"x": Column(unit="m")}).columns["x"]
    assert (column.unit, column.kind) == ("m", "real")
    assert glossary.lookup("x").unit == "1"  # the phase of a primitive
    assert "x" not in glossary.columns()


@pytest.mark.parametrize(
    ("rows", "held", "told"), [(2**21, 0, ""), (2**22, 2**20, ""), (2**22, 2**20 - 1, "similar size")]
)
def test_few_holes_and_small_columns_are_no_matter(rows: int, held: int, told: str) -> None:
    with pytest.raises(LogError, match=told) if told else contextlib.nullcontext():
        refuse_ragged(rows, {"x": 100, "y": 28}, held)


def ramp(rows: int = 101, rate: float = 100.0, t0_ns: int = 0) -> Table:
    """Everything moves at constant speed, so interpolation must be exact."""
    t = np.arange(rows) / rate
    w, v = np.array([0.3, -0.4, 0.5]), np.array([1.0, 2.0, 3.0])
    T = se3.from_rp(so3.exp(t[:, None] * w), t[:, None] * v)
    values = {"q": np.stack([t, -2 * t], axis=1), "T_base_tool": T, "quat": quaternion.from_matrix(T[:, :3, :3])}
    values |= {
        "seq": np.arange(rows),
        "late": np.arange(rows) % 2 == 1,
        "word": np.array([f"w{i}" for i in range(rows)]),
    }
    columns = {"quat": Column(unit="1", kind="quaternion"), "word": Column(unit="1", kind="text")}
    return Table(t, values, columns, t0_ns=t0_ns)


@settings(max_examples=20)
@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=30, unique=True))
def test_motion_at_constant_speed_is_exact_at_any_time(times: list[float]) -> None:
    t = np.sort(np.array(times))
    table = ramp()
    if len(t) > 1 and (np.diff(t) <= 0).any():
        return
    try:
        found = table.resample(t)
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


def test_rates() -> None:
    table = ramp()
    assert len(table.resample(1000.0)) == 1001
    assert table.resample(1000.0).t[-1] == table.t[-1]
    with pytest.raises(ShapeError, match=r"at least 100 Hz, got 50 Hz.*signals\.lowpass_offline"):
        table.resample(50.0)
    for rate in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(ShapeError, match="rate above 0 Hz"):
            table.resample(rate)
    for rate in (1e9, 1e308):
        with pytest.raises(ShapeError, match=r"got 1e\+\d+ Hz over 1 s: \S+ rows from 101 rows\. Pass the rate"):
            table.resample(rate)
    with pytest.raises(ShapeError, match="t in seconds"):
        replace(table, t=1e9 * table.t).resample(100.0)
    with pytest.raises(ShapeError, match=r"between 0 and 1 s, got 1\.01 s in row 1. Tables are not extrapolated"):
        table.resample(np.array([0.5, 1.01]))
    with pytest.raises(ShapeError, match="two rows"):
        ramp(1).resample(100.0)
    assert table.resample(table.t).sha256 == table.sha256
    assert "resample" in table.resample(table.t).source[-1]


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
    q = ramp()["q"].copy()
    q[50] = np.nan  # stays NaN, and affects only its neighbours
    found = ramp().with_column("q", q).resample(200.0)
    assert np.flatnonzero(np.isnan(found["q"]).any(axis=1)).tolist() == [99, 100, 101]


def test_joining_holds_the_last_row_and_tells_its_age() -> None:
    values = {"wrench": np.arange(18.0).reshape(3, 6), "tick": [5, 6, 7]}
    left, right = ramp(t0_ns=WALL), Table([0.0, 0.1, 0.5], values, t0_ns=WALL + 200_000_000)
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
        left.join(right, fill="cubic")
    with pytest.raises(ShapeError, match="q in both"):
        left.join(left.select("q"))


def test_concatenation_keeps_the_gap_and_refuses_what_does_not_fit() -> None:
    first, second = ramp(t0_ns=WALL), ramp(t0_ns=WALL + 5_000_000_000)
    both = concat(first, second)
    assert len(both) == 202
    assert both.t[101] == pytest.approx(5.0)
    assert np.array_equal(both["q"][101:], second["q"])
    assert concat(first).sha256 == first.sha256
    by_hand = concat(ramp(), ramp().shifted(2.0))
    assert by_hand.t[101] == pytest.approx(2.0)
    table = ramp()
    other = table.without("q").shifted(2.0)
    wrong = {"begin after 1 s, got 0 s; use shifted": [table, table], "table 2 differs in q": [table, other]}
    for words, tables in {**wrong, "at least one": []}.items():
        with pytest.raises(ShapeError, match=words):
            concat(*tables)


def mixed() -> Table:
    columns = {"grip": Column(unit="N"), "who": Column(unit="1", kind="text"), "q": Column(labels=("a", "b"))}
    values = {"q": [[0.1, 0.2], [0.3, np.nan]], "grip": [1.0, 2.0], "who": ["<me>", "you"]}
    return Table([0.0, 0.5], values, columns)


@pytest.mark.parametrize("package", ["pandas", "polars", "pyarrow", "xarray"])
def test_tables_become_those_of_other_libraries(package: str, monkeypatch) -> None:
    kind = {"pyarrow": "arrow"}.get(package, package)
    monkeypatch.setitem(sys.modules, package, None)
    words = f"Expected the package {package}, but it is not installed. Install it: pip install {package}"
    with pytest.raises(MissingExtra, match=words):
        getattr(mixed(), f"to_{kind}")()
    monkeypatch.undo()
    pytest.importorskip(package, reason=f"{package} is not installed")
    found = getattr(mixed(), f"to_{kind}")()
    if package == "xarray":
        assert found["q"].sel(q_0="b").values[0] == 0.2
        assert found["grip"].attrs["units"] == "N"
        return
    q2 = found["q2"].to_pylist() if package == "pyarrow" else list(found["q2"])
    assert q2[0] == 0.2
    assert math.isnan(q2[1])
    if package == "pyarrow":
        assert found.column_names == ["t", "q1", "q2", "grip", "who"]
        assert found.schema.field("grip").metadata == {b"unit": b"N"}
    if package == "pandas":
        assert found.attrs["units"]["q1"] == "rad"
        assert found.index.tolist() == [0.0, 0.5]
