"""LabComm streams in files: all dialects, samples at several rates, clocks that wrap around, damaged streams."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from armlab.errors import LogError, ShapeError, UnknownName
from armlab.log import read, read_labcomm
from armlab.wire.labcomm import Encoder, parse_lc
from armlab.wire.labcomm.types import DIALECTS, SampleType

TYPES = """
sample struct { int tm; double pos[7]; double vel[7]; double trq[7]; } robot_row;
sample struct { boolean on; struct { struct { double posRawAbs; float velFlt; } joint[2]; } robot[_]; } irb2ext;
sample float force[_];
sample long big;
sample string word;
sample struct { byte name[4]; double grid[2,_]; } odd;
"""
SAMPLES = {one.name: one for one in parse_lc(TYPES) if isinstance(one, SampleType)}


def row(k: int, tm: int | None = None) -> dict[str, object]:
    pos = [0.1 * k + i for i in range(7)]
    return {"tm": 1000 + 4 * k if tm is None else tm, "pos": pos, "vel": [0.0] * 7, "trq": [float("nan")] * 7}


def stream(dialect: str, values: Sequence[tuple[str, object]]) -> bytes:
    encoder = Encoder(dialect)
    data = encoder.version()
    for name in dict.fromkeys(name for name, _ in values):
        data += encoder.define(SAMPLES[name])
    return data + b"".join(encoder.data(SAMPLES[name], value) for name, value in values)


@pytest.mark.parametrize("dialect", DIALECTS)
def test_every_dialect(tmp_path: Path, dialect: str) -> None:
    path = tmp_path / "run.labcomm"
    path.write_bytes(stream(dialect, [("robot_row", row(k)) for k in range(300)]))
    table = read(path)
    np.testing.assert_allclose(table.t, 0.004 * np.arange(300), atol=1e-12)
    assert table["robot_row.pos"].shape == (300, 7)
    assert table["robot_row.pos"][4].tolist() == row(4)["pos"]
    assert np.isnan(table["robot_row.trq"]).all()
    assert (table.units["robot_row.vel"], table["robot_row.tm"].dtype) == ("rad/s", np.int64)
    np.testing.assert_array_equal(table.matching("robot_row_pos"), table["robot_row.pos"])
    assert read(path, ["robot_row.pos"]).names == ("robot_row.pos",)
    assert "run.labcomm sha256" in table.source[0]


def test_samples_at_other_rates_are_held_and_nothing_is_zero(tmp_path: Path) -> None:
    joint = [{"posRawAbs": 1.5, "velFlt": 2.5}, {"posRawAbs": -1.0, "velFlt": 0.0}]
    values: list[tuple[str, object]] = [("robot_row", row(0)), ("force", [1.0, 2.0]), ("big", 2**62 + 1)]
    values += [("robot_row", row(1)), ("irb2ext", {"on": True, "robot": [{"joint": joint}]}), ("word", "hä")]
    values += [("robot_row", row(2)), ("force", [3.0]), ("odd", {"name": b"abc\0", "grid": [[1.0], [2.0]]})]
    odd = {"name": b"xyz\0", "grid": [[3.0, 4.0], [5.0, 6.0]]}
    values += [("robot_row", row(3)), ("odd", odd), ("robot_row", row(4))]
    path = tmp_path / "mixed"
    path.write_bytes(stream("2014v1", values))
    table = read_labcomm(path)
    nan = np.nan
    np.testing.assert_array_equal(table["force"], [[nan, nan], [1, 2], [1, 2], [3, nan], [3, nan]])
    np.testing.assert_array_equal(table["irb2ext.robot[0].joint[0].posRawAbs"], [nan, nan, 1.5, 1.5, 1.5])
    np.testing.assert_array_equal(table["irb2ext.on"], [nan, nan, 1, 1, 1])
    assert table["word"].tolist() == ["", "", "hä", "hä", "hä"]
    np.testing.assert_array_equal(table["odd.name"][3], [97, 98, 99, 0])
    np.testing.assert_array_equal(table["odd.grid"][3], [[1, nan], [2, nan]])
    np.testing.assert_array_equal(table["odd.grid"][4], [[3, 4], [5, 6]])
    np.testing.assert_array_equal(table.matching(r"robot_0.*posRawAbs")[4], [1.5, -1.0])
    assert table.names[:4] == ("robot_row.tm", "robot_row.pos", "robot_row.vel", "robot_row.trq")
    values[0], values[2] = values[2], values[0]  # the whole number is there from the first row on
    path.write_bytes(stream("2014v1", values))
    table = read_labcomm(path)
    assert table["big"].dtype == np.int64
    assert set(table["big"]) == {2**62 + 1}


def test_a_clock_that_wraps_and_one_that_stands(tmp_path: Path) -> None:
    path = tmp_path / "wraps"
    stamps = [2**31 - 6, 2**31 - 2, -(2**31) + 2, -(2**31) + 2, -(2**31) + 6]
    path.write_bytes(stream("2014v1", [("robot_row", row(k, tm)) for k, tm in enumerate(stamps)]))
    with pytest.warns(UserWarning, match=r"1 rows dropped: their time does not increase \(row 3\)"):
        table = read(path)
    np.testing.assert_allclose(table.t, [0.0, 0.004, 0.008, 0.012])
    assert table["robot_row.pos"][3, 0] == pytest.approx(0.4)
    assert "1 rows dropped" in table.notes[0]
    assert len(read(path, raw=True)) == 5


def test_without_a_clock_the_rate_is_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "force"
    path.write_bytes(stream("2006", [("force", [1.0 * k]) for k in range(4)] + [("big", 1)]))
    with pytest.raises(LogError, match=r"clock .* in the sample 'force' .*got force, big\. Pass the rate"):
        read(path)
    table = read_labcomm(path, rate=1 / 0.004032)
    np.testing.assert_allclose(table.t, 0.004032 * np.arange(4))
    assert len(read_labcomm(path, sample="big", rate=1.0)) == 1
    refused = [
        ("word", 1.0, UnknownName, r"'word'.*force"),
        (np.array([1, 2]), 1.0, UnknownName, "sample with values"),
        (None, 0.0, LogError, "rate above 0 Hz"),
        (np.array([]), np.eye(3), ShapeError, r"the rate \[Hz\] to be one number"),
    ]
    for sample, rate, error, words in refused:
        with pytest.raises(error, match=words):
            read_labcomm(path, sample=sample, rate=rate)


def test_a_stream_cut_anywhere_is_read_as_far_as_it_goes(tmp_path: Path) -> None:
    data = stream("2014v1", [("robot_row", row(k)) for k in range(3)])
    path = tmp_path / "cut"
    size = (len(data) - len(stream("2014v1", [("robot_row", row(0))]))) // 2
    first = len(data) - 2 * size
    for length in sorted({*range(first, len(data) + 1, 6), first + 1, first + size - 1, first + size, len(data)}):
        path.write_bytes(data[:length])
        rows, torn = 1 + (length - first) // size, (length - first) % size
        if torn:
            with pytest.warns(UserWarning, match=f"ends within a packet: its last {torn} bytes are skipped"):
                assert len(read(path)) == rows
        else:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                assert len(read(path)) == rows


def test_bad_streams_name_the_byte(tmp_path: Path) -> None:
    data = bytearray(stream("2014v1", [("robot_row", row(k)) for k in range(3)]))
    path = tmp_path / "bad"
    place = data.rindex(row(0)["tm"].to_bytes(4, "big"))  # type: ignore[union-attr]
    data[place - 1] ^= 1  # in the length of the first value, which begins one byte before
    path.write_bytes(data)
    words = rf"Expected a valid LabComm stream in .*bad, got an error at byte {place - 2}: .*\.$"
    with pytest.raises(LogError, match=words):  # in one line
        read(path)
    for data, words in ((stream("2014v1", []), "got only definitions"), (b"\x01\x02other bytes\0", "a file of format")):
        path.write_bytes(data)
        with pytest.raises(LogError, match=words):
            read_labcomm(path)
    with pytest.raises(LogError, match="No such file"):
        read_labcomm(tmp_path / "none")


def declared_twice(path: Path, first: str, one: object, second: str, other: object) -> Path:
    """Write a sample x with values of two types ("int", "double[3]"), as if two programs had written one file."""
    data = b""
    for k, (kind, value) in enumerate([(first, one), (second, other)]):
        name, bracket, size = kind.partition("[")
        (sample,) = (made for made in parse_lc(f"sample {name} x{bracket}{size};") if isinstance(made, SampleType))
        encoder = Encoder()
        data += b"" if k else encoder.version()
        data += encoder.define(sample) + encoder.data(sample, value)
    path.write_bytes(data)
    return path


def test_a_sample_that_is_declared_with_two_types(tmp_path: Path) -> None:
    path = tmp_path / "run.labcomm"
    assert read_labcomm(declared_twice(path, "int", 3, "double", 1.5), rate=1.0)["x"].tolist() == [3.0, 1.5]
    assert read_labcomm(declared_twice(path, "boolean", True, "int", 7), rate=1.0)["x"].tolist() == [1, 7]
    for first, second, told in (
        (("int", 3), ("string", "a"), "numbers or strings in x, got both"),
        (("string", "4"), ("double", 1.5), "numbers or strings in x, got both"),
        (("double", 7.5), ("double[3]", [1.0, 2.0, 3.0]), "arrays with 0 dimensions in x, got 1"),
        (("double[2]", [1.0, 2.0]), ("double", 7.5), "arrays with 1 dimensions in x, got 0"),
    ):
        with pytest.raises(LogError, match=rf"Expected samples .*run\.labcomm.*{told}"):
            read_labcomm(declared_twice(path, *first, *second), rate=1.0)


def test_one_long_value_does_not_ask_for_memory_in_all_rows(tmp_path: Path) -> None:
    path = tmp_path / "run.labcomm"
    for name, one, most in (("force", [0.5], 200_000), ("word", "x", 500_000)):
        path.write_bytes(stream("2014", [(name, one * (most if k == 7 else 1)) for k in range(2000)]))
        with pytest.raises(LogError, match=r"run\.labcomm.*Expected arrays of similar size, got 2000 rows with"):
            read_labcomm(path, rate=1.0)


def test_rows_are_those_of_the_sample_that_paces(tmp_path: Path) -> None:
    path = tmp_path / "run.labcomm"
    values: list[tuple[str, object]] = [("big", k) for k in range(9_000)]
    for k in (5, 500, 8_000):
        values.insert(k, ("force", [float(k)] * 10_000))
    path.write_bytes(stream("2014", values))
    table = read_labcomm(path, rate=1.0, sample="force")
    assert table["force"].shape == (3, 10_000)
    assert table["force"][:, 0].tolist() == [5.0, 500.0, 8_000.0]
