"""MATLAB files of all versions, and tables in them."""

from __future__ import annotations

import contextlib
import json
import struct
import sys
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import loadmat, savemat

from armlab import log
from armlab.errors import LogError, MissingExtra, UnknownName
from armlab.log import Column, Table, read_mat
from armlab.log.file_formats.mat import matlab_names, read_mat_table, variables_in, write_mat

ARRAYS = {"T": np.arange(12.0).reshape(3, 4), "few": np.array([[1, 2, 3]], dtype=np.int16)}


def save_73(path: Path, arrays: dict[str, np.ndarray]) -> Path:
    """Write as MATLAB does: 512 bytes of text before HDF5, columns as rows."""
    h5py = pytest.importorskip("h5py", reason="needs h5py: MAT files of version 7.3 are HDF5")
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, array in arrays.items():
            file[name] = np.ascontiguousarray(array.T)
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64, HDF5 schema 1.00 .".ljust(124) + b"\0\2IM")
    return path


def test_read_mat_of_version_5(tmp_path: Path) -> None:
    savemat(tmp_path / "a.mat", {**ARRAYS, "text": "hello", "nothing": {"a": 1}, "z": np.array([1j])})
    found = read_mat(tmp_path / "a.mat")
    assert set(found) == set(ARRAYS)
    for name, array in ARRAYS.items():
        np.testing.assert_array_equal(found[name], array)


def test_one_variable(tmp_path: Path) -> None:
    savemat(tmp_path / "a.mat", ARRAYS)
    assert list(read_mat(tmp_path / "a.mat", "few")) == ["few"]
    with pytest.raises(UnknownName, match="few"):
        read_mat(tmp_path / "a.mat", "fewer")


def test_what_is_no_mat_file(tmp_path: Path) -> None:
    path = tmp_path / "a.mat"
    with pytest.raises(LogError, match="No such file"):
        read_mat(path)
    path.write_text("t,q\n1,2\n")
    with pytest.raises(LogError, match="begins with"):
        read_mat(path)
    savemat(path, {"text": "hello"})
    with pytest.raises(LogError, match="got none"):
        read_mat(path)


def test_without_h5py(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.mat"
    path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(512) + b"\x89HDF\r\n\x1a\n")
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(MissingExtra, match=r"pip install 'armlab\[data\]', or save again"):
        read_mat(path)


def attempt(path: Path, data: bytes) -> bool:
    path.write_bytes(data)
    try:
        read_mat(path)
    except (LogError, UnknownName) as error:
        assert str(error).endswith(".")  # noqa: PT017
        return False
    return True


def test_version_5_cut_at_every_byte(tmp_path: Path) -> None:
    savemat(tmp_path / "whole.mat", {"T": np.eye(4)})
    data = (tmp_path / "whole.mat").read_bytes()
    read = [attempt(tmp_path / "cut.mat", data[:n]) for n in range(len(data))]
    assert not any(read)


def test_version_73_cut_and_with_wrong_bytes(tmp_path: Path) -> None:
    data = save_73(tmp_path / "whole.mat", {"T": np.eye(4)}).read_bytes()
    assert not any(attempt(tmp_path / "cut.mat", data[:n]) for n in range(0, len(data), 29))
    rng = np.random.default_rng(0)
    for _ in range(80):
        spoilt = bytearray(data)
        spoilt[rng.integers(512, len(data))] = rng.integers(0, 256)
        attempt(tmp_path / "spoilt.mat", bytes(spoilt))


def saved(variables: dict[str, Any], packed: bool) -> bytes:
    file = BytesIO()
    savemat(file, variables, do_compression=packed)
    return file.getvalue()


@pytest.mark.parametrize("packed", [False, True])
def test_arrays_as_scipy_reads_them(packed: bool) -> None:
    arrays = {
        "few": np.array([[1, 2, 3]], np.int16),
        "deep": np.arange(24.0).reshape(2, 3, 4),
        "none": np.zeros((0, 3)),
        "flags": np.array([[True], [False]]),
        "large": np.array([[2**63]], np.uint64),
        "single": np.array([[0.1]], np.float32),
    }
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
    assert {k: None if v is None else v.tolist() for k, v in found.items()} == {
        "text": [["grå"]],
        "cells": [["a"], ["grå"], [""]],
        "mixed": None,
        "s": None,
        "z": None,
    }


def test_a_bomb_is_refused_by_the_size_that_it_tells(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("armlab.log.file_formats.mat._UNPACKED", 1000)
    monkeypatch.setattr("armlab.log.file_formats.mat._RATIO", 2)
    data = saved({"t": np.zeros(1000)}, packed=True)
    with pytest.raises(LogError, match="Expected variables of at most 1000 bytes in a file of this size, got 8"):
        variables_in(data)


@pytest.mark.parametrize("count", [200, pytest.param(2000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("packed", [False, True])
def test_wrong_bytes(packed: bool, count: int) -> None:
    """SciPy's reader ends the process on 3 % of those that are not packed."""
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


T = np.arange(4) * 0.004
VALUES = {"q": np.arange(8.0).reshape(4, 2), "force.raw": np.arange(4.0), "end": np.arange(4) + 2**60}
COLUMNS = {"force.raw": Column(unit="N"), "end": Column(unit="1", kind="count"), "q": Column(labels=("a", "b"))}


@pytest.fixture
def table() -> Table:
    mode = {"mode": np.array(["on", "", "grå", "off"])}
    return Table(T, {**VALUES, **mode}, {**COLUMNS, "mode": Column(unit="1", kind="text")}, source=("here",))


def test_names_that_matlab_allows() -> None:
    names = ["q", "force.raw", "force_raw", "end", "2nd", "t", "units", "_x", "grå", "x" * 70, "x" * 71, ""]
    found = matlab_names(names)
    assert found["q"] == "q"
    assert (found["force.raw"], found["force_raw"]) == ("force_raw_2", "force_raw")
    assert (found["end"], found["2nd"], found["_x"], found["grå"], found[""]) == ("xend", "x2nd", "x_x", "gr_", "x")
    assert (found["t"], found["units"]) == ("t_2", "units_2")
    assert len(set(found.values())) == len(names)
    assert all(len(name) <= 63 and name.isidentifier() for name in found.values())


def test_what_matlab_sees(table: Table, tmp_path: Path) -> None:
    found = loadmat(log.write(table, tmp_path / "run.mat"), simplify_cells=True)
    np.testing.assert_array_equal(found["t"], T)
    np.testing.assert_array_equal(found["q"], table["q"])
    assert found["xend"].tolist() == table["end"].tolist()
    assert found["mode"].tolist()[0] == "on"
    assert found["units"] == {"t": "s", "q": "rad", "force_raw": "N", "xend": "1", "mode": "1"}
    assert found["names"] == {"force_raw": "force.raw", "xend": "end"}
    about = json.loads(found["armlab"])
    assert about["source"] == ["here"]
    assert about["columns"]["q"]["labels"] == ["a", "b"]


def test_long_names_are_kept(tmp_path: Path) -> None:
    name = "a_name_of_more_than_thirty_one_characters"
    path = log.write(Table(T, {name: T}, {name: Column(unit="m")}), tmp_path / "run.mat")
    assert loadmat(path, simplify_cells=True)["units"][name] == "m"


def test_columns_of_two_gigabytes_are_refused(table: Table, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("armlab.log.file_formats.mat.LARGEST", 63)
    with pytest.raises(LogError, match=r"below 2 GB for a MAT file of version 5, got .* in 'q'\. Write HDF5.*\.h5"):
        log.write(table, tmp_path / "run.mat")
    assert not list(tmp_path.iterdir())
    assert callable(write_mat)


def test_a_log_of_matlab_in_both_orientations(tmp_path: Path) -> None:
    path = tmp_path / "run.mat"
    for flip in (lambda a: a, np.transpose):
        savemat(path, {"t": flip(T[:, None]), "pos": flip(VALUES["q"]), "gain": 3.0, "about": {"a": 1}})
        found = log.read(path)
        np.testing.assert_array_equal(found["q"], VALUES["q"])
        np.testing.assert_array_equal(found.t, T)
        assert found.notes == ("left out: about, gain (1, 1)",)
    assert read_mat_table(path).sha256 == found.sha256


def test_version_73(table: Table, tmp_path: Path) -> None:
    """What MATLAB makes of a file of ours by save -v7.3, and a log of its own."""
    h5py = pytest.importorskip("h5py", reason="MAT files of version 7.3 are HDF5")
    ours = loadmat(log.write(table.without("mode"), tmp_path / "run.mat"))
    path = tmp_path / "run73.mat"
    for kept in (True, False):
        with h5py.File(path, "w", userblock_size=512) as file:
            for name in ("t", "q", "force_raw", "xend"):
                file[name] = ours[name].T
            if kept:
                codes = np.frombuffer(str(ours["armlab"][0]).encode("utf-16-le"), "<u2")
                file["armlab"] = codes[:, None]
                file["armlab"].attrs["MATLAB_class"] = np.bytes_("char")
            file.create_group("units")
        with path.open("r+b") as raw:
            raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\0\2IM")
        found = log.read(path)
        if kept:
            assert found.sha256 == table.without("mode").sha256
        else:
            np.testing.assert_array_equal(found["q"], table["q"])
            assert found["xend"].tolist() == table["end"].tolist()
            assert found.notes == ("left out: units",)


def test_a_variable_that_was_deleted(table: Table, tmp_path: Path) -> None:
    found = loadmat(log.write(table, tmp_path / "run.mat"))
    del found["q"]
    savemat(tmp_path / "less.mat", {name: value for name, value in found.items() if not name.startswith("__")})
    with pytest.raises(LogError, match=r"variables that are described in .*less\.mat, got none for q"):
        log.read(tmp_path / "less.mat")
