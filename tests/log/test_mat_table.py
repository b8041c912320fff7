"""Tables in MAT files, as MATLAB sees them, and logs that MATLAB has written."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat, savemat

from armlab import log
from armlab.errors import LogError
from armlab.log import Column, Table
from armlab.log.file_formats.mat import matlab_names, read_mat_table, write_mat

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
