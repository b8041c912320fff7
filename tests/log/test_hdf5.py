"""Tables in HDF5."""

from __future__ import annotations

import gc
import resource
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from armlab import log
from armlab.errors import LogError, MissingExtra, UnknownName
from armlab.log import Column, Table
from armlab.log.file_formats.hdf5_parquet import read_hdf5, write_hdf5

h5py = pytest.importorskip("h5py", reason="HDF5 needs the extra data")
T = np.arange(4) * 0.004


@pytest.fixture
def table() -> Table:
    values = {"q": np.arange(8.0).reshape(4, 2), "a/b": np.arange(4) + 2**60, "mode": np.array(["on", "", "grå", "x"])}
    columns = {"a/b": Column(unit="1", kind="count"), "q": Column(labels=("a", "b"))}
    columns["mode"] = Column(unit="1", kind="text")
    return Table(T, values, columns, t0_ns=7, clock="robot", notes=("noted",), source=("here",))


def test_what_another_program_sees(table: Table, tmp_path: Path) -> None:
    with h5py.File(log.write(table, tmp_path / "run.h5")) as file:
        assert set(file) == {"t", "q", "a_b", "mode"}
        assert file["q"].shape == (4, 2)
        assert (file["q"].compression, file["q"].compression_opts, file["q"].shuffle) == ("gzip", 1, True)
        np.testing.assert_array_equal(file["q"], table["q"])
        assert {key: file["q"].attrs[key] for key in ("unit", "kind", "frame")} == {
            "unit": "rad",
            "kind": "angle",
            "frame": "joint",
        }
        assert list(file["q"].attrs["labels"]) == ["a", "b"]
        assert file["a_b"].attrs["name"] == "a/b"
        assert file["mode"].asstr()[2] == "grå"
        assert (file.attrs["t0_ns"], file.attrs["clock"], list(file.attrs["notes"])) == (7, "robot", ["noted"])
    assert callable(write_hdf5)


def test_single_columns(table: Table, tmp_path: Path) -> None:
    path = log.write(table, tmp_path / "run.hdf5")
    assert read_hdf5(path, ["mode"]).names == ("mode",)
    assert log.read(path, ["mode", "q"]).names == ("mode", "q")
    with pytest.raises(UnknownName, match="'qd'"):
        log.read(path, ["qd"])


def test_an_old_jld_file(tmp_path: Path) -> None:
    """HDF5 behind 512 bytes of text; matrices with one sample per column are (N, n) here. Objects are left out."""
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
    assert found.notes == ("left out: controller, name",)


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


def test_damaged_files(table: Table, tmp_path: Path, read_spoilt: Callable[..., None]) -> None:
    path = log.write(table, tmp_path / "run.h5")
    read_spoilt(path, path, 40)
    with h5py.File(path, "w") as file:
        file.attrs["armlab"], file["t"] = "0.1.0", T
    with pytest.raises(LogError, match="a whole HDF5 file"):
        log.read(path)


def test_without_h5py(table: Table, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = log.write(table, tmp_path / "run.h5")
    monkeypatch.setitem(sys.modules, "h5py", None)
    for job in (lambda: log.read(path), lambda: log.write(table, tmp_path / "again.h5")):
        with pytest.raises(MissingExtra, match=r"pip install 'armlab\[data\]'"):
            job()
    assert [entry.name for entry in tmp_path.iterdir()] == ["run.h5"]


@pytest.mark.parametrize("limit", [0, 100, 3000, 40_000, 120_000])
def test_a_disk_that_is_full_at_any_moment(tmp_path: Path, limit: int) -> None:
    """An error inside HDF5 would end the process: this test would not fail, it would take pytest with it."""
    rng = np.random.default_rng(1)
    table = Table(np.arange(900.0), {name: rng.normal(size=(900, 7)) for name in ("q", "qd", "tau")})
    old = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, old[1]))
    try:
        with pytest.raises(LogError, match="File too large"):
            log.write(table, tmp_path / "run.h5")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, old)
    gc.collect()
    assert not list(tmp_path.iterdir())
    assert log.read(log.write(table, tmp_path / "run.h5")).sha256 == table.sha256
