"""Tables that are hard to keep go into every format and come back the same: property-based."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from armlab import log
from armlab.glossary import columns as known
from armlab.lie import se3
from armlab.log import Column, Table

FORMATS = (".csv", ".mat", ".parquet", ".h5")
WORDS = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=8)
NASTY = ["", "1", "nan", " a,b ", '"', 'a "b", c', "line\nbreak", "\r", "\r\n", "ü😀", "\x01", "a'b", "\ufeff"]
TEXTS = st.sampled_from(NASTY) | WORDS
MEETING = ["a.b", "a:b", "a_b", "A_b", "a/b", "x" * 70, "x" * 69 + "y", "q1", "q[1]", "/t", "joint_states", "_"]
TAKEN = ["units", "names", "armlab", "end", "2nd", ".", "..", "T", "time", "columns"]
ODD = ["x y", "x, y", "l\nb", "\r", "it's", "grå", "a [b]", "robot[0].joint[2].posRawAbs"]
NAMES = st.sampled_from(MEETING + TAKEN + ODD) | WORDS.filter(lambda name: name not in {*known(), "", "t"})
UNITS = st.sampled_from(["1", "N", "N, N m", "rad", "furlong", "ü/s", "N m, J", "%"])
KINDS = ("real", "angle", "pose", "quaternion", "count", "flag", "text")
FRAMES = st.sampled_from(["", "base", "ü"])
REALS = st.floats(allow_nan=True, allow_infinity=True)


@st.composite
def values(draw: st.DrawFn, kind: str, rows: int) -> np.ndarray:
    shape = (rows, *draw(st.just(()) | array_shapes(min_dims=1, max_dims=3, min_side=0, max_side=3)))
    if kind == "text":
        words = draw(st.lists(TEXTS, min_size=int(np.prod(shape)), max_size=int(np.prod(shape))))
        return np.array(words, dtype=np.str_).reshape(shape)
    if kind == "count":
        return draw(arrays(np.int64, shape, elements=st.integers(-(2**63), 2**63 - 1)))
    if kind == "flag":
        return draw(arrays(np.bool_, shape))
    if kind == "pose" and draw(st.booleans()):
        poses = se3.exp(draw(arrays(float, (rows, 6), elements=st.floats(-3.0, 3.0))))
        return np.where(draw(arrays(np.bool_, (rows, 1, 1))), np.nan, poses)
    return draw(arrays(float, shape, elements=REALS))


@st.composite
def tables(draw: st.DrawFn) -> Table:
    rows = draw(st.integers(0, 4))
    steps = draw(st.lists(st.floats(1e-9, 10.0), min_size=rows, max_size=rows))
    t = np.cumsum([draw(st.floats(-1e6, 1e6)), *steps])[1:]
    t = t if (np.diff(t) > 0).all() else np.cumsum(steps)
    found, columns = {}, {}
    for name in draw(st.lists(NAMES, unique=True, max_size=4)):
        kind = draw(st.sampled_from(KINDS))
        found[name] = draw(values(kind, rows))
        first = found[name].shape[1:2]
        labels = draw(st.just(()) | st.tuples(*[TEXTS] * first[0])) if first else ()
        columns[name] = Column(unit=draw(UNITS), kind=kind, frame=draw(FRAMES), labels=labels)
    if draw(st.booleans()):
        found |= {"q": draw(arrays(float, (rows, 3), elements=REALS)), "seq": np.arange(rows) + 2**60}
        found |= {"wrench_hat": np.full((rows, 6), np.nan), "late": np.ones(rows, dtype=bool)}
    t0_ns, words = draw(st.integers(-(2**62), 2**62)), st.lists(TEXTS, max_size=2).map(tuple)
    return Table(t, found, columns, t0_ns=t0_ns, clock=draw(TEXTS), notes=draw(words), source=draw(words))


def about(table: Table) -> tuple[object, ...]:
    return table.names, dict(table.columns), table.t0_ns, table.clock, table.notes


def there_and_back(table: Table, folder: Path, ending: str, **options: str) -> Table:
    again = log.read(log.write(table, folder / f"run{ending}", **options))
    assert about(again) == about(table)
    assert again.source[0].startswith(f"run{ending} sha256 ")
    assert again.source[1:] == table.source
    return again


def examples(number: int) -> settings:
    slow = [HealthCheck.too_slow, HealthCheck.function_scoped_fixture]
    return settings(max_examples=number, deadline=None, suppress_health_check=slow)


def available(ending: str) -> None:
    for needs in {".parquet": ["pyarrow"], ".h5": ["h5py"]}.get(ending, []):
        pytest.importorskip(needs, reason=f"{ending} needs the extra data")


@pytest.mark.parametrize("ending", FORMATS)
@examples(15)
@given(table=tables())
def test_every_table_comes_back_the_same(ending: str, tmp_path: Path, table: Table) -> None:
    available(ending)
    assert there_and_back(table, tmp_path, ending).sha256 == table.sha256


@pytest.mark.slow
@pytest.mark.parametrize("ending", FORMATS)
@examples(400)
@given(table=tables())
def test_every_table_comes_back_the_same_often(ending: str, tmp_path: Path, table: Table) -> None:
    available(ending)
    assert there_and_back(table, tmp_path, ending).sha256 == table.sha256


def bag_and_back(table: Table, folder: Path, storage: str) -> None:
    table = Table(table.t, table.values, table.columns, abs(table.t0_ns) % 2**60, table.clock, source=table.source)
    again = there_and_back(table, folder, ".rosbag2", storage=storage)
    assert np.array_equal(again.t, table.t)
    for name in table.names:
        if table[name].dtype.kind == "f" and table.columns[name].kind == "pose":
            np.testing.assert_allclose(again[name], table[name], rtol=0, atol=1e-14)  # through quaternions
        else:
            np.testing.assert_array_equal(again[name], table[name])
            assert again[name].dtype.kind == table[name].dtype.kind


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@examples(10)
@given(table=tables())
def test_every_table_comes_back_from_a_rosbag2(storage: str, tmp_path: Path, table: Table) -> None:
    bag_and_back(table, tmp_path, storage)


@pytest.mark.slow
@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@examples(200)
@given(table=tables())
def test_every_table_comes_back_from_a_rosbag2_often(storage: str, tmp_path: Path, table: Table) -> None:
    bag_and_back(table, tmp_path, storage)
