"""Logs: ten minutes of 30 signals at 250 Hz, written to and read from every format, compared with the underlying
packages alone.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import scipy.io
from blocks import Contender, Disagreement, Table, once, table
from rosbags.highlevel import AnyReader

from armlab import log
from armlab.log import Column

ROWS, RATE = 150_000, 250.0
OUT, BAG_IN = 2.0, 1.0  # relative to the bare package: writing any format; reading a bag
TEXT = """\
t and 30 noisy signals (q, qd, tau of 7 joints, a wrench, 3 user signals), 36 MB. armlab also writes and checks the
column descriptions, and hashes the data it reads ({size:.0f} MB). Values and hash are restored exactly.
"""


def run(quick: bool) -> list[Table]:
    """Measure `log.write` and `log.read` of every format."""
    with tempfile.TemporaryDirectory() as folder:
        bench = _Bench(Path(folder), 2 if quick else 3)
        return [
            *bench.tables("MAT, version 5", ".mat", _savemat, _loadmat, "scipy.io"),
            *bench.tables("CSV", ".csv", _write_csv, _read_csv, "pyarrow.csv"),
            *bench.tables("Parquet", ".parquet", _write_parquet, _read_parquet, "pyarrow.parquet"),
            *bench.tables("HDF5", ".h5", _write_hdf5, _read_hdf5, "h5py"),
            *bench.tables("rosbag2, mcap", ".rosbag2", None, _read_bag, "rosbags"),
        ]


class _Bench:
    def __init__(self, folder: Path, rounds: int) -> None:
        rng = np.random.default_rng(0)
        t = np.arange(ROWS) / RATE
        values = {name: rng.normal(size=(ROWS, 7)) for name in ("q", "qd", "tau")}
        values |= {"wrench_hat": rng.normal(size=(ROWS, 6)), "grip": rng.normal(size=(ROWS, 3))}
        self.table = log.Table(t, values, {"grip": Column(unit="N")}, t0_ns=1_700_000_000_000_000_000)
        self.flat = np.hstack([t[:, None], *values.values()])
        self.folder, self.rounds = folder, rounds

    def tables(
        self,
        what: str,
        ending: str,
        write: Callable[..., Any] | None,
        read: Callable[..., Any],
        peer: str,
    ) -> list[Table]:
        """Return two tables: writing and reading."""
        ours, theirs = self.folder / f"ours{ending}", self.folder / f"theirs{ending}"
        out = [Contender("armlab log.write", once(lambda: log.write(self.table, ours)), "armlab")]
        if write is not None:
            out.append(Contender(f"{peer}, bare", once(lambda: write(self, theirs)), bar=OUT))
        tables = [table(f"{what}, out", self._text(ours), "s", out, self.rounds)]
        into = [
            Contender("armlab log.read", once(lambda: log.read(ours)), "armlab"),
            Contender(f"{peer}, bare", once(lambda: read(ours)), bar=None if write else BAG_IN),
        ]
        if ending in (".parquet", ".h5"):
            into.append(Contender("armlab log.read, only q", once(lambda: log.read(ours, ["q"])), "armlab"))
        tables.append(table(f"{what}, in", self._text(ours), "s", into, self.rounds))
        for path in (ours, theirs):
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
        return tables

    def _text(self, path: Path) -> str:
        """Check that a written file restores the hash; return the text with the file size."""
        again = log.read(log.write(self.table, path))
        if again.sha256 != self.table.sha256:
            raise Disagreement(f"{path.name}: expected the hash of the table, got a different one.")
        files = path.iterdir() if path.is_dir() else [path]
        return TEXT.format(size=sum(file.stat().st_size for file in files) / 1e6)


def _savemat(bench: _Bench, path: Path) -> None:
    scipy.io.savemat(path, {"t": bench.table.t, **bench.table.values})


def _loadmat(path: Path) -> Any:
    return scipy.io.loadmat(path)


def _arrow(bench: _Bench) -> pa.Table:
    columns = [pa.array(np.ascontiguousarray(column)) for column in bench.flat.T]
    return pa.table(columns, names=[f"c{k}" for k in range(len(columns))])


def _write_csv(bench: _Bench, path: Path) -> None:
    pyarrow.csv.write_csv(_arrow(bench), path)


def _read_csv(path: Path) -> Any:
    return pyarrow.csv.read_csv(path)


def _write_parquet(bench: _Bench, path: Path) -> None:
    pyarrow.parquet.write_table(
        _arrow(bench), path, compression="zstd", use_dictionary=False, use_byte_stream_split=True
    )


def _read_parquet(path: Path) -> Any:
    return [column.to_numpy() for column in pyarrow.parquet.read_table(path).columns]


def _write_hdf5(bench: _Bench, path: Path) -> None:
    with h5py.File(path, "w") as file:
        for name, array in {"t": bench.table.t, **bench.table.values}.items():
            file.create_dataset(name, data=array, compression="gzip", compression_opts=1, shuffle=True)


def _read_hdf5(path: Path) -> Any:
    with h5py.File(path, "r") as file:
        return [file[name][()] for name in file]


def _read_bag(path: Path) -> Any:
    with AnyReader([path]) as bag:
        for connection, _, raw in bag.messages():
            if connection.topic == "/joint_states":
                bag.deserialize(raw, connection.msgtype)
