"""Tables in MAT files of all versions, HDF5 and Parquet."""

from __future__ import annotations

import contextlib
import json
import struct
import sys
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import loadmat, savemat

from armlab import log
from armlab.errors import LogError, MissingExtra, UnknownName
from armlab.log import Column, Table, read_mat
from armlab.log.file_formats.mat import matlab_names, variables_in

pa = pytest.importorskip("pyarrow", reason="Parquet needs the extra data")
pq = pytest.importorskip("pyarrow.parquet")
h5py = pytest.importorskip("h5py", reason="HDF5 needs the extra data")
T = np.arange(4) * 0.004


@pytest.fixture
def table() -> Table:
    values = {"q": np.arange(8.0).reshape(4, 2), "wrench_hat": np.ones((4, 6)), "q1": np.arange(4) + 2**60}
    values |= {"force/raw": np.arange(4.0), "end": np.arange(4), "mode": np.array(["on", "", "grå", "x"])}
    columns = {"q": Column(labels=("a", "b")), "mode": Column(unit="1", kind="text"), "force/raw": Column(unit="N")}
    columns |= dict.fromkeys(("q1", "end"), Column(unit="1", kind="count"))
    return Table(T, values, columns, t0_ns=7, clock="robot", notes=("noted",), source=("here",))


def test_what_another_program_sees(table: Table, tmp_path: Path) -> None:
    path = log.write(table, tmp_path / "run.parquet")
    found = pq.read_table(path)
    wrench = [f"wrench_hat{k}" for k in range(1, 7)]
    assert found.column_names == ["t", "q1", "q2", *wrench, "q1_2", "force/raw", "end", "mode"]
    assert {found.field(name).metadata[b"unit"] for name in ("q1", "q2")} == {b"rad"}
    assert found.field("wrench_hat4").metadata[b"unit"] == b"N m"
    assert found.column("q1_2").to_pylist() == table["q1"].tolist()
    assert found.column("mode").to_pylist() == ["on", "", "grå", "x"]
    chunk = pq.ParquetFile(path).metadata.row_group(0).column(1)
    assert chunk.compression == "ZSTD"
    assert set(chunk.encodings) == {"RLE", "BYTE_STREAM_SPLIT"}  # RLE: the levels, all equal
    assert not chunk.has_dictionary_page


@pytest.mark.parametrize("ending", [".parquet", ".hdf5"])
def test_single_columns(table: Table, tmp_path: Path, ending: str) -> None:
    path = log.write(table, tmp_path / f"run{ending}")
    assert log.read(path, ["q1"])["q1"].tolist() == table["q1"].tolist()
    assert log.read(path, ["mode", "q"]).names == ("mode", "q")
    with pytest.raises(UnknownName, match="'qd'"):
        log.read(path, ["qd"])


def test_more_than_one_group_of_rows(table: Table, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("armlab.log.file_formats.hdf5_parquet.ROWS", 3)
    path = log.write(table, tmp_path / "run.parquet")
    assert pq.ParquetFile(path).num_row_groups == 2
    assert log.read(path).sha256 == table.sha256


def test_a_table_of_another_program(tmp_path: Path) -> None:
    path = tmp_path / "run.parquet"
    columns = {"q1 [deg]": [180.0, None], "q2 [deg]": [0.0, 90.0], "count": [2**60 + 1, 2**60 + 2], "on": [True, False]}
    columns |= {"time": pa.array([10**18, 10**18 + 4 * 10**6], pa.timestamp("ns")), "mode": ["a", None]}
    found = pa.table({**columns, "list": [[1], [2]]})
    pq.write_table(found, path)
    table = log.read(path)
    assert table.t.tolist() == [0.0, 0.004]
    np.testing.assert_allclose(table["q"], [[np.pi, 0.0], [np.nan, np.pi / 2]])
    found_values = {name: table[name].tolist() for name in ("count", "mode", "on")}
    assert found_values == {"count": [2**60 + 1, 2**60 + 2], "mode": ["a", ""], "on": [1, 0]}
    assert table.notes == ("skipped: list (list<element: int64>)",)
    pq.write_table(found.select(["count"]), path)
    with pytest.raises(LogError, match=r"Expected a column t \[s\] in .*got count"):
        log.read(path)


@pytest.mark.parametrize(("ending", "what"), [(".parquet", "Parquet"), (".h5", "HDF5")])
def test_damaged_files(table: Table, tmp_path: Path, read_spoilt: Callable[..., None], ending: str, what: str) -> None:
    path = log.write(table, tmp_path / f"run{ending}")
    read_spoilt(path, path, 20)
    path.write_bytes(path.read_bytes()[:50])
    with pytest.raises(LogError, match=f"a valid {what} file"):
        log.read(path)
    if ending == ".h5":
        with h5py.File(path, "w") as file:
            file.attrs["armlab"], file["t"] = "0.1.0", T
        with pytest.raises(LogError, match="a valid HDF5 file"):
            log.read(path)


@pytest.mark.parametrize(("module", "ending"), [("pyarrow", ".parquet"), ("h5py", ".h5")])
def test_without_an_extra(
    table: Table, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, module: str, ending: str
) -> None:
    path = log.write(table, tmp_path / f"run{ending}")
    (tmp_path / "a.mat").write_bytes(b"MATLAB 7.3 MAT-file".ljust(512) + b"\x89HDF\r\n\x1a\n")
    monkeypatch.setitem(sys.modules, module, None)
    for job in (lambda: log.read(path), lambda: log.write(table, tmp_path / f"again{ending}")):
        with pytest.raises(MissingExtra, match=rf"Expected the package {module} .*pip install 'armlab\[data\]'"):
            job()
    if module == "h5py":
        with pytest.raises(MissingExtra, match=r"pip install 'armlab\[data\]', or save it again"):
            read_mat(tmp_path / "a.mat")
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["a.mat", path.name]


ARRAYS = {"T": np.arange(12.0).reshape(3, 4), "few": np.array([[1, 2, 3]], dtype=np.int16)}


def save_73(path: Path, arrays: dict[str, np.ndarray]) -> Path:
    """Write as MATLAB does: 512 bytes of text before the HDF5 data, columns as rows."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, array in arrays.items():
            file[name] = np.ascontiguousarray(array.T)
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64, HDF5 schema 1.00 .".ljust(124) + b"\0\2IM")
    return path


def test_read_mat_of_version_5_and_what_it_refuses(tmp_path: Path) -> None:
    path = tmp_path / "a.mat"
    savemat(path, {**ARRAYS, "text": "hello", "nothing": {"a": 1}, "z": np.array([1j])})
    found = read_mat(path)
    assert set(found) == set(ARRAYS)
    for name, array in ARRAYS.items():
        np.testing.assert_array_equal(found[name], array)
    path.unlink()
    with pytest.raises(LogError, match="No such file"):
        read_mat(path)
    path.write_text("t,q\n1,2\n")
    with pytest.raises(LogError, match="begins with"):
        read_mat(path)
    savemat(path, {"text": "hello"})
    with pytest.raises(LogError, match="got none"):
        read_mat(path)


def test_files_cut_and_with_wrong_bytes(tmp_path: Path) -> None:
    def is_read(data: bytes) -> bool:
        (tmp_path / "cut.mat").write_bytes(data)
        with contextlib.suppress(LogError):
            return bool(read_mat(tmp_path / "cut.mat"))
        return False

    savemat(tmp_path / "whole.mat", {"T": np.eye(4)})
    data = (tmp_path / "whole.mat").read_bytes()
    assert not any(is_read(data[:n]) for n in range(len(data)))
    data = save_73(tmp_path / "whole.mat", {"T": np.eye(4)}).read_bytes()
    assert not any(is_read(data[:n]) for n in range(0, len(data), 97))
    rng = np.random.default_rng(0)
    for place, value in zip(rng.integers(512, len(data), 30).tolist(), rng.integers(0, 256, 30), strict=True):
        is_read(data[:place] + bytes([value]) + data[place + 1 :])


def saved(variables: dict[str, Any], packed: bool) -> bytes:
    file = BytesIO()
    savemat(file, variables, do_compression=packed)
    return file.getvalue()


@pytest.mark.parametrize("packed", [False, True])
def test_arrays_as_scipy_reads_them(packed: bool) -> None:
    arrays = {"few": np.array([[1, 2, 3]], np.int16), "deep": np.arange(24.0).reshape(2, 3, 4)}
    arrays |= {"flags": np.array([[True], [False]]), "large": np.array([[2**63]], np.uint64), "none": np.zeros((0, 3))}
    arrays["single"] = np.array([[0.1]], np.float32)
    data = saved(arrays, packed)
    found, wanted = variables_in(data), loadmat(BytesIO(data))
    assert set(found) == set(arrays)
    for name, array in found.items():
        assert array is not None
        assert array.dtype == wanted[name].dtype
        np.testing.assert_array_equal(array, wanted[name])


def test_a_file_of_a_big_endian_computer() -> None:
    flags, sizes = struct.pack(">IIII", 6, 8, 6, 0), struct.pack(">IIii", 5, 8, 2, 1)
    body = flags + sizes + struct.pack(">HH4s", 1, 1, b"t") + struct.pack(">IIdd", 9, 16, 1.0, 2.0)
    data = b"MATLAB 5.0".ljust(124) + b"\1\0MI" + struct.pack(">II", 14, len(body)) + body
    np.testing.assert_array_equal(variables_in(data)["t"], [[1.0], [2.0]])


def test_texts_cells_and_what_is_neither() -> None:
    cells = np.array([["a"], ["grå"], [""]], dtype=object)
    mixed = np.array([[1.0], ["b"]], dtype=object)
    found = variables_in(saved({"text": "grå", "cells": cells, "mixed": mixed, "s": {"a": 1}, "z": 1j}, packed=False))
    wanted = {"text": [["grå"]], "cells": [["a"], ["grå"], [""]], "mixed": None, "s": None, "z": None}
    assert {k: None if v is None else v.tolist() for k, v in found.items()} == wanted


def test_a_bomb_is_refused_by_the_size_that_it_tells(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("armlab.log.file_formats.mat._UNPACKED", 1000)
    monkeypatch.setattr("armlab.log.file_formats.mat._RATIO", 2)
    data = saved({"t": np.zeros(1000)}, packed=True)
    with pytest.raises(LogError, match="Expected variables of at most 1000 bytes in a file of this size, got 8"):
        variables_in(data)


@pytest.mark.parametrize("count", [100, pytest.param(1500, marks=pytest.mark.slow)])
@pytest.mark.parametrize("packed", [False, True])
def test_wrong_bytes(packed: bool, count: int) -> None:
    """SciPy's reader crashes the process on 3 % of the uncompressed files."""
    cells = np.array([["a"], ["grå"], [""]], dtype=object)
    variables = {"t": np.arange(20.0), "text": "hello", "cells": cells, "s": {"a": 1.0}, "z": np.array([1j])}
    data = saved(variables, packed)
    rng = np.random.default_rng(0)
    for _ in range(count):
        spoilt = np.frombuffer(data, dtype=np.uint8).copy()
        places = rng.integers(124, len(data), rng.integers(1, 6))
        spoilt[places] = rng.choice(np.array([0, 1, 127, 128, 255, rng.integers(256)]), len(places))
        with contextlib.suppress(LogError, ValueError, OverflowError):
            variables_in(spoilt.tobytes())


def test_names_that_matlab_allows() -> None:
    names = ["q", "force.raw", "force_raw", "end", "2nd", "t", "units", "_x", "grå", "x" * 70, "x" * 71, ""]
    found = matlab_names(names)
    wanted = {"q": "q", "force.raw": "force_raw_2", "force_raw": "force_raw", "end": "xend", "2nd": "x2nd", "_x": "x_x"}
    wanted |= {"grå": "gr_", "": "x", "t": "t_2", "units": "units_2"}
    assert {name: found[name] for name in wanted} == wanted
    assert len(set(found.values())) == len(names)
    assert all(len(name) <= 63 and name.isidentifier() for name in found.values())


def test_what_matlab_sees(table: Table, tmp_path: Path) -> None:
    found = loadmat(log.write(table, tmp_path / "run.mat"), simplify_cells=True)
    np.testing.assert_array_equal(found["t"], T)
    np.testing.assert_array_equal(found["q"], table["q"])
    assert found["q1"].tolist() == table["q1"].tolist()
    assert found["mode"].tolist()[0] == "on"
    assert {"t": "s", "q": "rad", "force_raw": "N", "xend": "1"}.items() <= found["units"].items()
    assert found["names"] == {"force_raw": "force/raw", "xend": "end"}
    about = json.loads(found["armlab"])
    assert (about["source"], about["columns"]["q"]["labels"]) == (["here"], ["a", "b"])
    del found["q"]
    savemat(tmp_path / "less.mat", {name: one for name, one in found.items() if name[:2] != "__"})
    with pytest.raises(LogError, match=r"variables described in .*less\.mat, but q are missing\."):
        log.read(tmp_path / "less.mat")
    name = "a_name_of_more_than_thirty_one_characters"
    path = log.write(Table(T, {name: T}, {name: Column(unit="m")}), tmp_path / "run.mat")
    assert loadmat(path, simplify_cells=True)["units"][name] == "m"


def test_columns_of_two_gigabytes_are_refused(table: Table, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("armlab.log.file_formats.mat.LARGEST", 63)
    with pytest.raises(LogError, match=r"below 2 GB for a MAT file of version 5, got .* in 'q'\. To write HDF5.*\.h5"):
        log.write(table, tmp_path / "run.mat")
    assert not list(tmp_path.iterdir())


def test_a_log_of_matlab_in_both_orientations(tmp_path: Path) -> None:
    path, q = tmp_path / "run.mat", np.arange(8.0).reshape(4, 2)
    for flip in (lambda a: a, np.transpose):
        savemat(path, {"t": flip(T[:, None]), "pos": flip(q), "gain": 3.0, "about": {"a": 1}})
        found = log.read(path)
        np.testing.assert_array_equal(found["q"], q)
        np.testing.assert_array_equal(found.t, T)
        assert found.notes == ("skipped: about, gain (1, 1)",)


def test_version_73(table: Table, tmp_path: Path) -> None:
    """Our file as MATLAB re-saves it with save -v7.3, and a log as MATLAB itself writes it."""
    table = table.without("mode")
    ours = loadmat(log.write(table, tmp_path / "run.mat"))
    codes = np.frombuffer(str(ours["armlab"][0]).encode("utf-16-le"), "<u2")
    path = tmp_path / "run73.mat"
    for kept in (True, False):
        arrays = {name: ours[name] for name in ("t", "q", "wrench_hat", "q1", "force_raw", "xend")}
        save_73(path, {**arrays, "armlab": codes[None]} if kept else arrays)
        with h5py.File(path, "r+") as file:
            file.create_group("units")
            if kept:
                file["armlab"].attrs["MATLAB_class"] = np.bytes_("char")
        found = log.read(path)
        if kept:
            assert found.sha256 == table.sha256
        else:
            np.testing.assert_array_equal(found["q"], table["q"])
            assert found["xend"].tolist() == table["end"].tolist()
            assert found.notes == ("skipped: units",)


def test_what_another_program_sees_hdf5(table: Table, tmp_path: Path) -> None:
    with h5py.File(log.write(table, tmp_path / "run.h5")) as file:
        assert set(file) == {"t", "q", "wrench_hat", "q1", "force_raw", "end", "mode"}
        assert (file["q"].compression, file["q"].compression_opts, file["q"].shuffle) == ("gzip", 1, True)
        np.testing.assert_array_equal(file["q"], table["q"])
        wanted = {"unit": "rad", "kind": "angle", "frame": "joint"}
        assert {key: file["q"].attrs[key] for key in wanted} == wanted
        assert list(file["q"].attrs["labels"]) == ["a", "b"]
        assert file["force_raw"].attrs["name"] == "force/raw"
        assert file["mode"].asstr()[2] == "grå"
        assert (file.attrs["t0_ns"], file.attrs["clock"], list(file.attrs["notes"])) == (7, "robot", ["noted"])


def test_an_old_jld_file(tmp_path: Path) -> None:
    """HDF5 behind 512 bytes of text; matrices with one sample per column are (N, n) here. Objects are skipped."""
    path = tmp_path / "log.jld"
    q = np.arange(8.0).reshape(4, 2)
    with h5py.File(path, "w", userblock_size=512) as file:
        file["log/pos"], file["timestamp"], file["pos"] = q, T, q
        file["controller"] = np.zeros(2, dtype=[("gain", "f8"), ("on", "i4")])
        file["_types/00000001"] = np.zeros(1, dtype=[("a", "f8")])
        file["name"] = "left"
    with path.open("r+b") as raw:
        raw.write(b"Julia data file (HDF5), version 0.1.1\n")
    found = log.read(path)
    np.testing.assert_array_equal(found["q"], q)
    np.testing.assert_array_equal(found["log.pos"], q)
    assert found.notes == ("skipped: controller, name",)


def test_a_log_of_another_program(tmp_path: Path) -> None:
    path = tmp_path / "other.h5"
    with h5py.File(path, "w") as file:
        file["time"], file["q"] = np.array([0, 4, 8, 12]), np.full((4, 2), 180.0)
        file["time"].attrs["units"], file["q"].attrs["unit"] = "ms", "deg"
    found = log.read(path)
    np.testing.assert_allclose(found.t, T)
    np.testing.assert_allclose(found["q"], np.pi)
    with h5py.File(path, "w") as file:
        file["q"] = np.zeros((4, 2))
    with pytest.raises(LogError, match=r"Expected times t, time or timestamp in .*other\.h5, got q \(4, 2\)"):
        log.read(path)


def save_struct(path: Path, fields: dict[str, np.ndarray]) -> Path:
    """Write as JLD.jl does when a struct is saved whole: a compound of references into _refs."""
    with h5py.File(path, "w") as file:
        kept = [file.create_dataset(f"_refs/{k:08d}", data=array) for k, array in enumerate(fields.values())]
        row = np.empty((), dtype=[(f"{name}_", h5py.ref_dtype) for name in fields])
        for name, one in zip(fields, kept):
            row[f"{name}_"] = one.ref
        file["log"] = row
    return path


def test_a_struct_of_julia_saved_whole_is_read_or_refused_with_what_to_do(tmp_path: Path) -> None:
    rows = np.random.default_rng(0).normal(size=(30, 7))
    fields = {"pos": rows, "vel": rows + 1, "trq": rows + 2, "timestamp": 0.004 * np.arange(30)}
    read = log.read(save_struct(tmp_path / "whole.jld", fields))
    for name, source in (("q", "pos"), ("qd", "vel"), ("tau", "trq")):
        np.testing.assert_array_equal(read[name], fields[source])
    np.testing.assert_allclose(read.t, fields["timestamp"])
    with h5py.File(tmp_path / "odd.jld", "w") as file:
        file["log"] = np.zeros((), dtype=[("name_", "S4"), ("data_", "V8")])
    with pytest.raises(LogError, match=r'a struct .* compound type.*save\("log.jld", "pos", log.pos'):
        log.read(tmp_path / "odd.jld")
