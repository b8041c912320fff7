"""A `Table` in HDF5: plain datasets (N, ...) with attributes, which any program reads.

Julia's HDF5.jl and MATLAB show the axes in reverse: (n, N), one sample per column, as the ancestors' logs were. Their
old ``.jld`` files are HDF5 inside: plain numeric datasets are read, the rest is named and left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import msgspec
import numpy as np

from armlab._interrupts import deferred
from armlab.errors import ArmlabError, LogError, UnknownName
from armlab.log.column import Column
from armlab.log.file_formats.column_labels import foreign_table
from armlab.log.file_formats.description import Description, Progress, distinct
from armlab.log.file_formats.opening import check_unpacked_size, needed
from armlab.log.table import Table

CHUNK = 1 << 18  # bytes: what a reader of a few rows unpacks


def write_hdf5(table: Table, file: BinaryIO, progress: Progress) -> None:
    """Write a dataset per column, shuffled and packed by gzip, with attributes unit, kind, frame and labels, if any."""
    h5py = needed("h5py", "for HDF5")
    names = distinct({name: name.replace("/", "_").strip(".") or "_" for name in table.names}, ["t"])
    about = msgspec.structs.asdict(Description.of(table))
    memory = BytesIO()  # an error of the disk in the middle of a write would end the process in HDF5
    with h5py.File(memory, "w") as whole:
        with deferred():
            for key in ("armlab", "t0_ns", "clock"):
                whole.attrs[key] = about[key]
            for key in ("notes", "source"):
                _put_texts(h5py, whole, key, about[key])
            _dataset(h5py, whole, "t", table.t).attrs["unit"] = "s"
        for place, (name, own) in enumerate(names.items()):
            with deferred():
                _put_column(h5py, _dataset(h5py, whole, own, table[name]), place, name, about["columns"][name])
            progress(place + 1, len(names), "columns")
    file.write(memory.getbuffer())


def _put_column(h5py: Any, one: Any, place: int, name: str, described: Any) -> None:
    """Put what is said of a column on its dataset; what is not said takes no attribute and no time."""
    one.attrs["place"] = place
    own = name if name != one.name.removeprefix("/") else ""
    texts = {"name": own, "unit": described.unit, "kind": described.kind, "frame": described.frame}
    for key, text in texts.items():
        if text:
            one.attrs[key] = text
    if described.labels:
        _put_texts(h5py, one, "labels", described.labels)


def _put_texts(h5py: Any, item: Any, key: str, texts: Sequence[str]) -> None:
    item.attrs.create(key, np.array(texts, dtype=object), dtype=h5py.string_dtype())


def _dataset(h5py: Any, whole: Any, name: str, array: np.ndarray) -> Any:
    if not array.size:
        return whole.create_dataset(name, array.shape, h5py.string_dtype() if array.dtype.kind == "U" else array.dtype)
    if array.dtype.kind == "U":
        return whole.create_dataset(name, data=array.astype(object), dtype=h5py.string_dtype())
    rows = max(1, min(len(array), CHUNK * len(array) // array.nbytes))
    chunks = (rows, *array.shape[1:])
    return whole.create_dataset(name, data=array, chunks=chunks, compression="gzip", compression_opts=1, shuffle=True)


def read_hdf5(path: Path, columns: Sequence[str] | None = None, *, raw: bool = False) -> Table:
    """Return the table in an HDF5 file: one of `write_hdf5`, or the datasets of another program by `foreign_table`."""
    h5py = needed("h5py", f"to read {path}, a file in HDF5")
    try:
        with h5py.File(path, "r") as whole:
            check_unpacked_size(path, stored_size(h5py, whole))
            if "armlab" not in whole.attrs:
                arrays, left_out = _datasets(h5py, whole)
                return foreign_table(path, arrays, left_out, raw)
            about, names = _described(whole)
            wanted = list(names) if columns is None else list(columns)
            for name in wanted:
                if name not in names:
                    raise UnknownName.among("column", name, names)
            return about.table(path, whole["t"][()], {name: _values(whole[names[name]]) for name in wanted})
    except ArmlabError:
        raise
    except Exception as error:  # h5py raises OSError, RuntimeError, KeyError and more on damaged files
        what = " ".join(str(error).split()).rstrip(".") or type(error).__name__
        raise LogError(f"Expected a whole HDF5 file at {path}, got a damaged one: {what[:200]}.") from None


def stored_size(h5py: Any, whole: Any) -> int:
    """Return the bytes of all datasets of a file once they are unpacked; a text counts as 16."""
    sizes = []
    whole.visititems(lambda _, item: sizes.append(item.nbytes) if isinstance(item, h5py.Dataset) else None)
    return sum(sizes)


def _described(whole: Any) -> tuple[Description, dict[str, str]]:
    """Return the description in the attributes, and the dataset of each column."""
    names, described = {}, {}
    columns = [(own, one) for own, one in whole.items() if own != "t"]
    for own, one in sorted(columns, key=lambda entry: int(entry[1].attrs["place"])):
        name = str(one.attrs.get("name", own))
        texts = {key: str(one.attrs.get(key, "")) for key in ("unit", "kind", "frame")}
        names[name], described[name] = own, Column(one.shape[1:], labels=tuple(one.attrs.get("labels", ())), **texts)
    texts = {key: str(whole.attrs[key]) for key in ("armlab", "clock")}
    lists = {key: tuple(whole.attrs[key]) for key in ("notes", "source")}
    return Description.made(described, t0_ns=int(whole.attrs["t0_ns"]), **texts, **lists), names


def _datasets(h5py: Any, whole: Any) -> tuple[Mapping[str, tuple[np.ndarray, str]], list[str]]:
    """Return the numbers and texts of another program with their units, and the names of what else there is."""
    found: dict[str, tuple[np.ndarray, str]] = {}
    left_out: list[str] = []

    def visit(name: str, item: Any) -> None:
        if not isinstance(item, h5py.Dataset):
            return
        text = h5py.check_string_dtype(item.dtype)
        if item.dtype.kind in "biuf" or (text is not None and item.ndim == 1):
            unit = item.attrs.get("unit", item.attrs.get("units", ""))
            found[name.replace("/", ".")] = (_values(item), unit if isinstance(unit, str) else "")
        elif not name.startswith("_"):  # _types, _refs and _creator of a .jld are its own business
            left_out.append(name)

    whole.visititems(visit)
    return found, left_out


def _values(item: Any) -> np.ndarray:
    array = item[()] if item.dtype.kind in "biuf" else item.asstr()[()]
    return np.asarray(array) if array.dtype.kind in "biuf" else np.array(array.tolist(), np.str_).reshape(array.shape)
