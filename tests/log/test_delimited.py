"""Delimited text, and labels, units and descriptions of columns."""

from __future__ import annotations

import gzip
import io
import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from armlab import log
from armlab.errors import LogError
from armlab.log import Column, Table, read, read_csv, write
from armlab.log.file_formats.delimited import LONGEST, _numbers_only, sidecar_path, write_csv
from armlab.log.file_formats.description import Description, foreign_table, labelled_table, of_json

ROWS = "t [ms],q1 [deg],q2 [deg],tau_1,tau_2,grip [N]\n0,180,0,1,2,0.5\n4,90,-90,1.5,,0.5\n8,0,0,2,4,0.5\n"


def written(folder: Path, text: str, name: str = "log.csv") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_units_are_converted_and_joints_put_together(tmp_path: Path) -> None:
    table = read_csv(written(tmp_path, ROWS))
    np.testing.assert_allclose(table.t, [0, 0.004, 0.008])
    np.testing.assert_allclose(table["q"], [[np.pi, 0], [np.pi / 2, -np.pi / 2], [0, 0]])
    np.testing.assert_array_equal(table["tau"], [[1, 2], [1.5, np.nan], [2, 4]])
    assert dict(table.units) == {"q": "rad", "tau": "N m", "grip": "N"}
    assert table.source[0].startswith("log.csv sha256 ")


def test_labels_and_texts_of_other_tools(tmp_path: Path) -> None:
    """ROS exports, orca logs, semicolons, a byte-order mark, Windows line endings, blank lines, preamble lines."""
    ros = read_csv(written(tmp_path, "t,- arm_1_joint_effort,- arm_2_joint_effort\n0,1,2\n0.01,3,4\n"))
    np.testing.assert_array_equal(ros.matching("arm_1_joint"), [[1], [3]])
    text = "\ufeffmade by a logger\r\nt;robot[0].joint[0].posRawAbs\r\n0;1\r\n1;2\r\n\r\n"
    orca = read_csv(written(tmp_path, text), skip=1, separator=";")
    np.testing.assert_array_equal(orca.matching("robot_0.*posRawAbs"), [[1], [2]])
    path = written(tmp_path, "Joint_1,Joint_2\n1,2\n3,4\n5,6\n")
    with pytest.raises(LogError, match=r"Expected a column t \[s\].*got Joint_1, Joint_2\. Pass rate="):
        read_csv(path)
    table = read_csv(path, rate=5000.0)
    np.testing.assert_allclose(table.t, [0, 2e-4, 4e-4])
    np.testing.assert_array_equal(table.matching("Joint_"), [[1, 2], [3, 4], [5, 6]])
    assert len(read_csv(path, rate=5000.0, every=2)) == 2
    spaces = read_csv(written(tmp_path, "t,a,b\n0,1\x1d,x\n0.1, \x1c2,\x1d\n"))  # whitespace only in Python
    assert np.array_equal(spaces["a"], [1.0, 2.0])
    assert spaces["b"].dtype.kind == "U"
    table = read_csv(written(tmp_path, "t,mode,x\n0,auto,1\n1,,2\n2,manual,nan\n"))  # words make a text column
    assert table["mode"].tolist() == ["auto", "", "manual"]
    assert np.isnan(table["x"][2])
    assert any("mode: read as text because of 'auto'" in note for note in table.notes)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("t,x\n0,1\n1,2,3\n", r"Expected 2 fields separated by ',' in line 3 .*got 3"),
        ("t;x\n0;1,5\n1;2,5\n", r"decimal point in the column 'x' .*'1,5' in line 2"),
        ("t;x\n0;1\n1;2,5\n", r"decimal point in the column 'x' .*'2,5' in line 3"),
        ("t,x,x\n0,1,2\n", r"unique names .*'x' twice"),
        ("t,x,\n0,1,2\n", r"a column without a name"),
        ("t,x [furlong]\n0,1\n", r"supported unit for 'x' .*'furlong'.*Known: s, ms"),
        ("t [m],x\n0,1\n", r"times in s, ms, us or ns in the column 't'.*got m"),
        ("t,x\n0,1\n,2\n", r"a time in every row.*a missing time in line 3"),
        ("now,x\n0,1\n", r"Expected a column t \[s\]"),
        ("t,x\n", r"a header and rows of numbers .*got 1 lines after the first 0"),
        ("t,q1 [N]\n0,1\n", r"columns that match the glossary"),
        ("t,q1 [deg],q2 [m]\n0,1,2\n", r"one unit for the components of q, got m, rad"),
    ],
)
def test_bad_files_get_a_sentence(tmp_path: Path, text: str, sentence: str) -> None:
    separator = ";" if text.startswith("t;") else ","
    with pytest.raises(LogError, match=sentence):
        read_csv(written(tmp_path, text), separator=separator)


def test_whole_numbers_beyond_every_float_are_infinite(tmp_path: Path) -> None:
    text = f"t,x [1],y [1]\n0,1{'0' * 400},1\n1,-1{'0' * 400},2\n2,{'1' * 5000},{2**62 + 1}\n"
    table = read_csv(written(tmp_path, text))
    assert table["x"].tolist() == [np.inf, -np.inf, np.inf]
    assert table["y"].tolist() == [1, 2, 2**62 + 1]


def test_files_that_are_no_text(tmp_path: Path) -> None:
    path, packed = tmp_path / "log.csv", gzip.compress(ROWS.encode())
    with pytest.raises(LogError, match="No such file"):
        read_csv(path)
    for data, words in (
        (b"PAR1\0\0\0\0", "got a file of format Parquet"),
        (packed[:-12], "delimited UTF-8 text"),
        (packed[:10] + b"\0\0\0\0\0" + packed[15:], "delimited UTF-8 text"),
        (b"t,\xff\n0,1\n", "delimited UTF-8 text"),
    ):
        path.write_bytes(data)
        with pytest.raises(LogError, match=words):
            read_csv(path)
    with pytest.raises(LogError, match="one character as separator"):
        read_csv(path, separator="tab")


@pytest.mark.parametrize(
    ("text", "separator"),
    [
        ("t,x\n0,1\n1,+2\n2,.5\n3,1.\n", ","),  # numbers that are invalid in JSON
        ("t;x\r\n0;1\r\n1;2\r\n2;.5\r\n3;1\r\n", ";"),
        ("t x\n0 1\n1 2\n2 0.5\n3 1e0\n", " "),
        ("t\tx\n0\t1\n1\t2\n2\t5e-1\n3\t1\n", "\t"),
        ('"t","x"\n"0",1\n1,2\n2,0.5\n3,1\n\n\n', ","),
        ("t,x\n0,1\n1,2\n2,0.5\n3,0x1\n".replace("0x1", " 1 "), ","),
    ],
)
def test_numbers_in_any_writing(tmp_path: Path, text: str, separator: str) -> None:
    table = read_csv(written(tmp_path, text), separator=separator)
    assert table["x"].tolist() == [1.0, 2.0, 0.5, 1.0]


@pytest.mark.parametrize("word", ["true", "null", "[1]", '"1', "1e", "NaN", "Infinity", "--1", "0x10", "1_000"])
def test_words_that_json_or_python_take_for_numbers(tmp_path: Path, word: str) -> None:
    path = written(tmp_path, f"t,x,k\n0,1,1\n1,{word},2\n")
    if word == '"1':
        with pytest.raises(LogError, match="Expected 3 fields"):
            read_csv(path)
        return
    expected = {"NaN": np.nan, "Infinity": np.inf, "1_000": 1000.0}
    found = read_csv(path)["x"]
    if word in expected:
        np.testing.assert_array_equal(found, [1.0, expected[word]])
    else:
        assert found.tolist() == ["1", word]


@pytest.mark.parametrize("size", [1, 7, 1 << 18])
def test_blocks_end_where_lines_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, size: int) -> None:
    monkeypatch.setattr("armlab.log.file_formats.delimited.BLOCK", size)
    path = written(tmp_path, "t,k\r\n" + "".join(f"{i},{2**60 + i}\r\n" for i in range(50)))
    assert read_csv(path)["k"].tolist() == [2**60 + i for i in range(50)]
    crossing = list(range(2**53 - 25, 2**53 + 25))
    path = written(tmp_path, "t,k\n" + "".join(f"{i},{k}\n" for i, k in enumerate(crossing)))
    assert read_csv(path)["k"].tolist() == crossing
    path = written(tmp_path, "t,k\n" + "".join(f"{i},{k}\n" for i, k in enumerate([0.5, *crossing])))
    assert read_csv(path)["k"][0] == 0.5


WORDS = ["", "1", 'a "b", c', "line\nbreak", "\r", "ü", " x "]


@pytest.fixture
def table() -> Table:
    """A table with more rows than two blocks."""
    rng = np.random.default_rng(2)
    n = 2_500
    real = rng.normal(size=(n, 3)) * 10.0 ** rng.integers(-300, 300, (n, 3))
    real[rng.integers(0, n, 99), 1] = np.nan
    real[:4, 0] = [np.inf, -np.inf, -0.0, 5e-324]
    found = {"reals": real, "id": rng.integers(-(2**63), 2**63 - 1, n), "on": rng.integers(0, 2, n).astype(bool)}
    found["mode"] = np.array(WORDS)[rng.integers(0, len(WORDS), n)]
    kinds = {"reals": "real", "id": "count", "on": "flag", "mode": "text"}
    return Table(np.arange(n) / 3, found, {name: Column(unit="1", kind=kind) for name, kind in kinds.items()})


@pytest.mark.parametrize("names", [("id", "on"), ("reals", "id", "on", "mode")])
def test_more_than_one_block_comes_back(
    table: Table, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, names: tuple[str, ...]
) -> None:
    monkeypatch.setattr("armlab.log.file_formats.delimited.ROWS_PER_BLOCK", 1000)
    monkeypatch.setattr("armlab.log.file_formats.delimited.BLOCK", 1 << 13)
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


SOME = 1 << 16


@contextmanager
def memory(most: float) -> Iterator[None]:
    """Check the peak memory use."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < most
    finally:
        tracemalloc.stop()


def put(path: Path, text: bytes, packed: bool = False) -> Path:
    path.write_bytes(gzip.compress(text, 6) if packed else text)
    return path


@pytest.mark.parametrize(("packed", "block", "digit"), [(False, 1, b"1"), (True, 7, b"a"), (False, 30, b"a")])
def test_a_line_is_as_long_as_is_allowed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, packed: bool, block: int, digit: bytes
) -> None:
    monkeypatch.setattr("armlab.log.file_formats.delimited.LONGEST", 40)
    monkeypatch.setattr("armlab.log.file_formats.delimited.BLOCK", block)
    path = put(tmp_path / "log", b"t,x\n0,1\n1," + digit * 37 + b"\n2,3\n", packed)
    assert len(log.read_csv(path)) == 3
    put(path, b"t,x\n0,1\n1," + digit * 38 + b"\n2,3\n", packed)
    with pytest.raises(LogError, match=r"Expected at most 40 characters in line 3 of .*log, got more\. End each row"):
        log.read_csv(path)


@pytest.mark.parametrize(("head", "packed"), [(b"", False), (b"t,x\n0,1\n1,", True)])
def test_a_line_of_megabytes_takes_no_memory(tmp_path: Path, head: bytes, packed: bool) -> None:
    path = put(tmp_path / "log", head + b"1" * (12 * LONGEST), packed)
    with memory(8 * LONGEST), pytest.raises(LogError, match=f"Expected at most {LONGEST} characters in line"):
        log.read_csv(path)
    put(path, b"t,x\r" + b"1,a\r" * (3 * LONGEST))  # these line endings make no long header
    with memory(8 * LONGEST):
        assert _numbers_only(path, 0, ",", 2) is None


@pytest.mark.parametrize(("digit", "most"), [(b"12", 16.0), (b"ab", 64.0)])
def test_what_unpacks_to_far_more_than_its_size_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, digit: bytes, most: float
) -> None:
    monkeypatch.setattr("armlab.log.file_formats.delimited._UNPACKED", SOME)
    text = b"x\n" + (digit + b"\n") * SOME
    path = put(tmp_path / "log", text, packed=True)
    words = rf"Expected at most {SOME} bytes of text, 200 times the file size, .* gunzip"
    with memory(most * SOME), pytest.raises(LogError, match=words):
        log.read_csv(path, rate=250.0)
    assert len(log.read_csv(put(path, text), rate=250.0)) == SOME
    monkeypatch.setattr("armlab.log.file_formats.delimited._UNPACKED", len(text))
    assert len(log.read_csv(put(path, text, packed=True), rate=250.0)) == SOME
    monkeypatch.setattr("armlab.log.file_formats.delimited._LINES", 1000)
    with pytest.raises(LogError, match=r"and 1000 lines in .*log, got more\. If you trust the file, unpack it"):
        log.read_csv(put(path, b"x\n" + b"1\n" * 1000, packed=True), rate=250.0)
    monkeypatch.setattr("armlab.log.file_formats.delimited._UNPACKED", 1 << 14)
    rows = [f"{0.004 * k:.3f}" + ",0.25" * 30 for k in range(1000)]  # an arm at rest is not a decompression bomb
    text = "\n".join(["t," + ",".join(f"c{k}" for k in range(30)), *rows])
    assert len(text) > 4 << 14
    assert len(log.read_csv(put(path, text.encode(), packed=True))) == 1000


def test_one_long_text_among_short_ones_is_refused(tmp_path: Path) -> None:
    path = put(tmp_path / "log", b"t,note\n" + b"0,a\n" * 20_000 + b"1," + b"a" * 100_000 + b"\n")
    with pytest.raises(LogError, match=r"arrays of similar size, got 20001 rows .* in log: note"):
        log.read_csv(path)


@pytest.mark.parametrize("line", [b"a\n", b"ab\n"])
def test_words_take_a_bounded_multiple_of_the_file(tmp_path: Path, line: bytes) -> None:
    path = put(tmp_path / "log", b"x\n" + b"ab\n" + line * 10_000)
    with memory(45.0 * path.stat().st_size):
        log.read_csv(path, rate=250.0)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    values = {"q": np.ones((3, 2)), "n": np.arange(3)}
    return write(Table([0.0, 0.1, 0.2], values, {"n": Column(unit="1", kind="count")}), tmp_path / "run.csv")


def test_descriptions_that_are_damaged_or_of_other_columns(path: Path) -> None:
    beside, cells = sidecar_path(path), path.read_text(encoding="utf-8")
    text = beside.read_text(encoding="utf-8")
    for old, new, words in (
        ('kind = "count"', 'kind = "number"', "kind of column"),
        ('kind = "count"', "kind = 3", r"Expected `str`, got `int`"),
        ('clock = "file"', 'clok = "file"', "unknown field `clok`"),
        ("shape = []", "shape = [", "run.csv.toml"),
        ("shape = []", "shape = [1000000, 1000000]", "at most 1048576 numbers"),
        ("shape = []", "shape = [-1]", "sizes of at least 0"),
    ):
        assert old in text
        beside.write_text(text.replace(old, new), encoding="utf-8")
        with pytest.raises(LogError, match=words) as told:
            read(path)
        assert str(told.value).endswith(".")
    beside.write_text(text, encoding="utf-8")
    for old, new, words in (
        ("0.2,1.0,1.0,2", "0.2,1.0,1.0,2.5", r"described in .*run\.csv, got invalid columns: .*'n' of kind count"),
        ("0.1,1.0,1.0,1", "0.1,1.0,1.0,1,7", r"Expected 4 fields .*line 3 "),
        ("0.1,1.0,1.0,1", "0.1,1.0,1.0,1x", r"columns that run\.csv\.toml describes"),
    ):
        path.write_text(cells.replace(old, new), encoding="utf-8")
        with pytest.raises(LogError, match=words):
            read(path)
    path.write_text("t [s],q1 [rad]\n0,1\n0.1,2\n")
    table = read(path)
    assert table["q"].tolist() == [[1.0], [2.0]]
    assert "run.csv.toml describes different columns and is ignored" in table.notes


@pytest.fixture
def path_described(tmp_path: Path) -> Path:
    (tmp_path / "run.x").write_text("anything")
    return tmp_path / "run.x"


T = np.arange(5) * 0.004


def test_a_log_of_the_ancestors(path_described: Path) -> None:
    """Fields of Robotlab.jl, one sample per column."""
    q = np.arange(35.0).reshape(5, 7)
    arrays = {"timestamp": T[None], "pos": q.T, "trq_o": q.T, "seqnum": np.arange(5)[None], "GR": np.eye(7)}
    table = foreign_table(path_described, {name: (array, "") for name, array in arrays.items()}, ["Log"])
    np.testing.assert_array_equal(table.t, T)
    np.testing.assert_array_equal(table["q"], q)
    assert (set(table.names), table["seq"].dtype) == ({"q", "tau_ref", "seq"}, np.int64)
    assert table.notes == ("skipped: Log, GR (7, 7)",)
    square = np.arange(25.0).reshape(5, 5)  # samples in rows are not transposed
    arrays = {"t": (T[:, None], "s"), "q": (square, "deg"), "T": (np.zeros((5, 4, 4)), ""), "x": (T[:, None], "")}
    table = foreign_table(path_described, arrays)
    np.testing.assert_allclose(table["q"], np.deg2rad(square))
    assert (table["T"].shape, table["x"].shape) == ((5, 4, 4), (5,))
    with pytest.raises(LogError, match=r"Expected times t, time or timestamp in .*, got q \(5, 7\), t \(2, 3\)\. Read"):
        foreign_table(path_described, {"q": (np.zeros((5, 7)), ""), "t": (np.zeros((2, 3)), "")})
    with pytest.raises(LogError, match=r"got none\."):
        foreign_table(path_described, {})
    arrays = {"t": (np.array([0.0, 1.0]), ""), "q999999999999": (np.array([0.0, 1.0]), "")}
    assert labelled_table(path_described, arrays).names == ("q999999999999",)  # not all indices up to it are listed


def test_a_description_goes_through_json(path_described: Path) -> None:
    table = Table([0.0, 0.5], {"q": [[1.0, 2.0], [3.0, 4.0]], "none": np.zeros((2, 0))}, {"none": Column(unit="m")})
    about = of_json(Description.of(table).json(more=[1]), path_described)
    assert about == Description.of(table)
    assert about.table(path_described, table.t, dict(table.values)).sha256 == table.sha256
    with pytest.raises(LogError, match="columns described in"):
        about.table(path_described, table.t, {"q": np.zeros((2, 3))})
    for text in ("", "[]", '{"armlab": 1}', '{"armlab": "1"}', b"\xff"):
        with pytest.raises(LogError, match=r"a description of the columns in .*Export the log again\."):
            of_json(text, path_described)
