"""A `Table` in Parquet: one flat column per component, with its unit, for pandas, Arrow, DuckDB and the like."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from armlab.errors import ArmlabError, LogError, UnknownName
from armlab.log.file_formats.column_labels import labelled_table, names_of
from armlab.log.file_formats.description import Description, Progress, components, distinct, of_json, put_together
from armlab.log.file_formats.opening import check_unpacked_size, needed
from armlab.log.table import Table

ROWS = 150_000  # of a group: ten minutes at 250 Hz


def write_parquet(table: Table, file: BinaryIO, progress: Progress) -> None:
    """Write columns t, q1, q2, ... packed by zstd, bytes of numbers in streams, units in the metadata of fields."""
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


def read_parquet(path: Path, columns: Sequence[str] | None = None, *, raw: bool = False) -> Table:
    """Return the table in a Parquet file: one of `write_parquet`, or the columns of another program."""
    what = f"to read {path}, a file in Parquet"
    pa, parquet = needed("pyarrow", what), needed("pyarrow.parquet", what)
    try:
        with parquet.ParquetFile(path) as file:
            check_unpacked_size(path, 8 * file.metadata.num_rows * file.metadata.num_columns)
            about = (file.schema_arrow.metadata or {}).get(b"armlab")
            if about is None:
                return _foreign(pa, path, file, raw)
            return _as_written(path, file, of_json(about, path), columns)
    except ArmlabError:
        raise
    except Exception as error:  # Arrow raises its own errors, OSError, and those of Python for damaged names
        what = " ".join(str(error).split()).rstrip(".")
        raise LogError(f"Expected a whole Parquet file at {path}, got a damaged one: {what[:200]}.") from None


def _as_written(path: Path, file: Any, about: Description, columns: Sequence[str] | None) -> Table:
    for name in columns or ():
        if name not in about.columns:
            raise UnknownName.among("column", name, about.columns)
    labels = list(file.schema_arrow.names)
    wanted = labels if columns is None else _labels_of(about, labels, columns)
    found = file.read(wanted)
    if columns is not None:
        about = about.selected(columns)
    t, *parts = (_values(found.column(label)) for label in wanted)
    return about.table(path, t, put_together(about, parts, len(t)))


def _labels_of(about: Description, labels: Sequence[str], columns: Sequence[str]) -> list[str]:
    """Return the labels of the clock and of the components of some columns."""
    kept, at = [labels[0]], 1
    for name, column in about.columns.items():
        size = int(np.prod(column.shape, dtype=int))
        kept += labels[at : at + size] if name in columns else []
        at += size
    return kept


def _foreign(pa: Any, path: Path, file: Any, raw: bool) -> Table:
    """Return the columns of another program; what is neither number nor text is left out and named."""
    table, left_out, arrays = file.read(), [], {}
    for field, (name, unit) in zip(table.schema, names_of(path, table.schema.names), strict=True):
        column = table.column(field.name)
        if pa.types.is_timestamp(field.type):
            column, unit = column.cast(pa.timestamp("ns")).cast(pa.int64()), "ns"
        elif pa.types.is_boolean(field.type):
            column = column.cast(pa.int8())
        elif not any(is_kind(field.type) for is_kind in _read(pa.types)):
            left_out.append(f"{field.name} ({field.type})")
            continue
        said = (field.metadata or {}).get(b"unit", b"").decode(errors="replace")
        arrays[name] = (_values(column), unit or said)
    notes = [f"left out: {', '.join(left_out)}"] if left_out else []
    return labelled_table(path, arrays, notes=notes, raw=raw)


def _read(types: Any) -> tuple[Any, ...]:
    return types.is_floating, types.is_integer, types.is_string, types.is_large_string


def _values(column: Any) -> np.ndarray:
    array = column.to_numpy()
    if array.dtype != object:
        return array
    return np.array(["" if text is None else text for text in array.tolist()], np.str_)
