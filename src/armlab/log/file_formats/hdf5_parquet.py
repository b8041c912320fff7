"""Tables in HDF5 and in Parquet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import msgspec
import numpy as np

from armlab._interrupts import deferred
from armlab.errors import LogError, UnknownName
from armlab.log.column import Column
from armlab.log.file_formats.column_names import ColumnNames
from armlab.log.file_formats.description import (
    Description,
    Progress,
    components,
    distinct,
    foreign_table,
    labelled_table,
    names_of,
    of_json,
    put_together,
    renamed,
)
from armlab.log.file_formats.opening import check_unpacked_size, needed, undamaged
from armlab.log.table import Table

CHUNK = 1 << 18  # bytes: smallest unit of decompression


def write_hdf5(table: Table, file: BinaryIO, progress: Progress) -> None:
    """Write one gzip-compressed dataset per column, with the attributes unit, kind, frame and labels (if any)."""
    h5py = needed("h5py", "for HDF5")
    names = distinct({name: name.replace("/", "_").strip(".") or "_" for name in table.names}, ["t"])
    about = msgspec.structs.asdict(Description.of(table))
    memory = BytesIO()  # a disk error during a write would crash the process inside HDF5
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
    """Write the description of a column to its dataset, omitting empty attributes."""
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


def read_hdf5(
    path: Path, columns: Sequence[str] | None = None, *, raw: bool = False, names: ColumnNames | None = None
) -> Table:
    """Return the table in an HDF5 file, written by `write_hdf5` or converted by `foreign_table`."""
    h5py = needed("h5py", f"to read the HDF5 file {path}")
    with undamaged(f"HDF5 file at {path}"), h5py.File(path, "r") as whole:
        check_unpacked_size(path, stored_size(h5py, whole))
        if "armlab" not in whole.attrs:
            arrays, left_out = _datasets(h5py, whole)
            if not arrays and left_out:
                raise LogError(
                    f"Expected arrays of numbers in {path}, got {', '.join(left_out)}: a struct or other compound "
                    "type. Save the fields one by one in Julia: "
                    'save("log.jld", "pos", log.pos, "vel", log.vel, "trq", log.trq, "timestamp", log.timestamp).'
                )
            return foreign_table(path, arrays, left_out, raw, names)
        about, own = _described(whole)
        wanted = list(own) if columns is None else list(columns)
        for name in wanted:
            if name not in own:
                raise UnknownName.among("column", name, own)
        table = about.table(path, whole["t"][()], {name: _values(whole[own[name]]) for name in wanted})
        return renamed(path, table, names)


def stored_size(h5py: Any, whole: Any) -> int:
    """Return the uncompressed size of all datasets in a file [bytes]; each string counts as 16 bytes."""
    sizes = []
    whole.visititems(lambda _, item: sizes.append(item.nbytes) if isinstance(item, h5py.Dataset) else None)
    return sum(sizes)


def _described(whole: Any) -> tuple[Description, dict[str, str]]:
    """Return the description from the attributes, and the dataset of each column."""
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
    """Return numeric and text datasets from another program with units, and the names of all other datasets."""
    found: dict[str, tuple[np.ndarray, str]] = {}
    left_out: list[str] = []

    def visit(name: str, item: Any) -> None:
        if not isinstance(item, h5py.Dataset) or name.startswith(("_refs/", "_types/", "_creator")):
            return  # metadata of .jld
        if item.dtype.names and item.size == 1:
            fields = _fields_of_struct(h5py, whole, item)
            found.update({f"{name.replace('/', '.')}.{own}": (array, "") for own, array in fields.items()})
            if fields:
                return
        text = h5py.check_string_dtype(item.dtype)
        if item.dtype.kind in "biuf" or (text is not None and item.ndim == 1):
            unit = item.attrs.get("unit", item.attrs.get("units", ""))
            found[name.replace("/", ".")] = (_values(item), unit if isinstance(unit, str) else "")
        else:
            left_out.append(name)

    whole.visititems(visit)
    structs = {name.partition(".")[0] for name in found if "." in name}
    if len(structs) == 1 and all("." in name for name in found):  # the fields of a single struct are columns
        found = {name.partition(".")[2]: entry for name, entry in found.items()}
    return found, left_out


def _fields_of_struct(h5py: Any, whole: Any, item: Any) -> dict[str, np.ndarray]:
    """Return the numeric arrays in a Julia struct, which is a compound of numbers and references."""
    row, found = item[()], {}
    row = row.reshape(-1)[0] if isinstance(row, np.ndarray) else row
    for name in item.dtype.names:
        value = row[name]
        if isinstance(value, h5py.Reference):
            value = whole[value][()] if value and isinstance(whole[value], h5py.Dataset) else None
        if isinstance(value, np.ndarray | np.generic) and np.asarray(value).dtype.kind in "biuf":
            found[name.rstrip("_")] = np.asarray(value)  # Julia writes pos as pos_
    return {name: array for name, array in found.items() if array.ndim}


def _values(item: Any) -> np.ndarray:
    array = item[()] if item.dtype.kind in "biuf" else item.asstr()[()]
    return np.asarray(array) if array.dtype.kind in "biuf" else np.array(array.tolist(), np.str_).reshape(array.shape)


ROWS = 150_000  # rows per group: ten minutes at 250 Hz


def write_parquet(table: Table, file: BinaryIO, progress: Progress) -> None:
    """Write columns t, q1, q2, ... with zstd and byte-stream split; units are in the field metadata."""
    pa, parquet = needed("pyarrow", "for Parquet"), needed("pyarrow.parquet", "for Parquet")
    parts = list(components(table))
    labels = list(distinct({place: label for place, (label, _, _) in enumerate(parts)}).values())
    arrays = [np.ascontiguousarray(values) for _, _, values in parts]
    types = [pa.string() if array.dtype.kind == "U" else pa.from_numpy_dtype(array.dtype) for array in arrays]
    fields = [
        pa.field(label, kind, nullable=False, metadata={"unit": unit})
        for label, kind, (_, unit, _) in zip(labels, types, parts, strict=True)
    ]
    schema = pa.schema(fields, metadata={"armlab": Description.of(table).json()})
    split = [label for label, array in zip(labels, arrays, strict=True) if array.dtype.kind in "fi"]
    options: dict[str, Any] = {"compression": "zstd", "use_dictionary": False, "use_byte_stream_split": split}
    with parquet.ParquetWriter(pa.PythonFile(file, mode="w"), schema, **options) as writer:
        for start in range(0, len(table), ROWS):
            block = [array[start : start + ROWS] for array in arrays]
            block = [pa.array(b.tolist() if b.dtype.kind == "U" else b, t) for b, t in zip(block, types, strict=True)]
            writer.write_table(pa.table(block, schema))
            progress(min(start + ROWS, len(table)), len(table), "rows")


def read_parquet(
    path: Path, columns: Sequence[str] | None = None, *, raw: bool = False, names: ColumnNames | None = None
) -> Table:
    """Return the table in a Parquet file, written by `write_parquet` or by another program."""
    what = f"to read the Parquet file {path}"
    pa, parquet = needed("pyarrow", what), needed("pyarrow.parquet", what)
    with undamaged(f"Parquet file at {path}"), parquet.ParquetFile(path) as file:
        check_unpacked_size(path, 8 * file.metadata.num_rows * file.metadata.num_columns)
        about = (file.schema_arrow.metadata or {}).get(b"armlab")
        if about is None:
            return _foreign(pa, path, file, raw, names)
        return renamed(path, _as_written(path, file, of_json(about, path), columns), names)


def _as_written(path: Path, file: Any, about: Description, columns: Sequence[str] | None) -> Table:
    for name in columns or ():
        if name not in about.columns:
            raise UnknownName.among("column", name, about.columns)
    clock, *labels = file.schema_arrow.names
    owners = [name for name, one in about.columns.items() for _ in range(int(np.prod(one.shape, dtype=int)))]
    wanted = [label for label, owner in zip(labels, owners) if columns is None or owner in columns]
    found = file.read([clock, *wanted])
    if columns is not None:
        about = msgspec.structs.replace(about, columns={k: v for k, v in about.columns.items() if k in columns})
    t, *parts = (_array_values(found.column(label)) for label in (clock, *wanted))
    return about.table(path, t, put_together(about, parts, len(t)))


def _foreign(pa: Any, path: Path, file: Any, raw: bool, names: ColumnNames | None) -> Table:
    """Return the columns from another program; columns that are neither numeric nor text are skipped and listed."""
    table, left_out, arrays = file.read(), [], {}
    kinds = pa.types.is_floating, pa.types.is_integer, pa.types.is_string, pa.types.is_large_string
    for field, (name, unit) in zip(table.schema, names_of(path, table.schema.names), strict=True):
        column = table.column(field.name)
        if pa.types.is_timestamp(field.type):
            column, unit = column.cast(pa.timestamp("ns")).cast(pa.int64()), "ns"
        elif pa.types.is_boolean(field.type):
            column = column.cast(pa.int8())
        elif not any(is_kind(field.type) for is_kind in kinds):
            left_out.append(f"{field.name} ({field.type})")
            continue
        said = (field.metadata or {}).get(b"unit", b"").decode(errors="replace")
        arrays[name] = (_array_values(column), unit or said)
    notes = [f"skipped: {', '.join(left_out)}"] if left_out else []
    return labelled_table(path, arrays, notes=notes, raw=raw, names=names)


def _array_values(column: Any) -> np.ndarray:
    array = column.to_numpy()
    if array.dtype != object:
        return array
    return np.array(["" if text is None else text for text in array.tolist()], np.str_)
