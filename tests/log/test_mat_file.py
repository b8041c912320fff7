"""MAT files of both kinds give the same arrays; damaged ones give arrays or a sentence."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from armlab.errors import LogError, MissingExtra, UnknownName
from armlab.log import read_mat
from armlab.log.file_formats.mat import read_variables

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


def test_read_mat_of_version_73_transposes(tmp_path: Path) -> None:
    found = read_mat(save_73(tmp_path / "a.mat", ARRAYS))
    for name, array in ARRAYS.items():
        np.testing.assert_array_equal(found[name], array)


def test_one_variable(tmp_path: Path) -> None:
    savemat(tmp_path / "a.mat", ARRAYS)
    assert list(read_mat(tmp_path / "a.mat", "few")) == ["few"]
    with pytest.raises(UnknownName, match="few"):
        read_mat(tmp_path / "a.mat", "fewer")


def test_variables_keep_their_types_and_text(tmp_path: Path) -> None:
    cells = np.array([["a"], ["grå"], [""]], dtype=object)
    mixed = np.array([[1.0], ["b"]], dtype=object)
    savemat(tmp_path / "a.mat", {**ARRAYS, "text": "hello", "cells": cells, "mixed": mixed, "z": np.array([1j])})
    found, left_out = read_variables(tmp_path / "a.mat")
    assert found["few"].dtype == np.int16
    assert found["text"].tolist() == [["hello"]]
    assert found["cells"].tolist() == [["a"], ["grå"], [""]]
    assert left_out == ["mixed", "z"]


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
    assert not any(attempt(tmp_path / "cut.mat", data[:n]) for n in range(0, len(data), 7))
    rng = np.random.default_rng(0)
    for _ in range(200):
        spoilt = bytearray(data)
        spoilt[rng.integers(512, len(data))] = rng.integers(0, 256)
        attempt(tmp_path / "spoilt.mat", bytes(spoilt))
