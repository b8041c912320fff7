"""MATLAB files: read arrays of versions 5 to 7.2 and of 7.3 (HDF5, with h5py), and write a `Table` in version 5.

SciPy is not used because it trusts the sizes in a file, so a corrupt file could crash the process. Format: MATLAB,
"MAT-File Level 5 File Format".

HDF5 stores MATLAB's columns as rows, so every array of a v7.3 file is transposed on reading.

In MATLAB, ``run = load('run.mat')`` gives ``run.t``, ``run.q`` (N, n) and ``run.units.q``. ``run.names`` holds the
original names of columns whose names MATLAB does not allow; ``run.armlab`` holds all other metadata as JSON.
"""

from __future__ import annotations

import math
import re
import struct
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from armlab.errors import LogError, UnknownName
from armlab.log.file_formats.column_names import ColumnNames
from armlab.log.file_formats.description import Description, Progress, distinct, foreign_table, of_json, renamed
from armlab.log.file_formats.hdf5_parquet import stored_size
from armlab.log.file_formats.opening import FIRST, check_unpacked_size, format_of, needed, undamaged
from armlab.log.table import Table

_HEADER = 128  # bytes before the first element: text, version, byte order
_MATRIX, _COMPRESSED = 14, 15  # kinds of elements
_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_TEXTS = {1: "ascii", 2: "ascii", 4: "utf-16", 16: "utf-8", 17: "utf-16", 18: "utf-32"}
_CELL, _CHARS, _OPAQUE = 1, 4, 17  # classes of matrices
_NUMERIC = range(6, 16)
_CLASSES = range(1, 18)
_COMPLEX = 0x0800
_UNPACKED, _RATIO = 1 << 26, 200  # decompressed bytes that are always allowed; above that, the maximum expansion ratio


def variables_in(data: bytes) -> dict[str, np.ndarray | None]:
    """Return the variables of a file: real numbers as stored, strings, and cells of strings; others are None."""
    order = {b"IM": "<", b"MI": ">"}.get(data[126:_HEADER])
    if order is None:
        raise LogError("Expected the byte-order mark IM or MI, got an invalid mark.")
    left = max(_UNPACKED, _RATIO * len(data))
    found = {}
    for kind, body in _elements(memoryview(data)[_HEADER:], order):
        if kind == _COMPRESSED:
            kind, body = _unpacked(body, order, left)
            left -= len(body)
        if kind != _MATRIX:
            raise LogError(f"Expected a variable, got an element of kind {kind}.")
        name, value = _matrix(body, order)
        found[name] = value
    return found


def _elements(view: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """Yield the kind and data of each element; elements are aligned to 8 bytes unless compressed."""
    at = 0
    while at < len(view):
        if len(view) - at < 8:
            raise LogError("Expected an element of at least 8 bytes, got the end of the file.")
        kind, size = struct.unpack_from(order + "II", view, at)
        start, end = at + 8, at + 8 + size
        if kind >> 16:  # small element: up to 4 bytes of data inside the tag
            kind, size = kind & 0xFFFF, kind >> 16
            start, end = at + 4, at + 4 + size
            if size > 4:
                raise LogError(f"Expected a small element of up to 4 bytes, got {size}.")
        if end > len(view):
            raise LogError(f"Expected an element of {size} bytes, got {len(view) - start}.")
        yield kind, view[start:end]
        at = end if kind == _COMPRESSED else end + -end % 8


def _unpacked(body: memoryview, order: str, most: int) -> tuple[int, memoryview]:
    """Return the kind and data of a compressed element, which starts with its uncompressed size."""
    packed = zlib.decompressobj()
    try:
        kind, size = struct.unpack(order + "II", packed.decompress(body, 8))
        if size > most:
            raise LogError(
                f"Expected variables of at most {most} bytes in a file "
                f"of this size, got {size}. Save the file from MATLAB with save(..., '-nocompression')."
            )
        data = packed.decompress(packed.unconsumed_tail, size + 1)
    except (zlib.error, struct.error) as error:
        raise LogError(f"Expected compressed data, got: {error}.") from None
    if len(data) != size or not packed.eof:
        raise LogError(f"Expected {size} bytes of compressed data, got a different size.")
    return kind, memoryview(data)


def _matrix(body: memoryview, order: str) -> tuple[str, np.ndarray | None]:
    parts = _elements(body, order)
    flags = _flags(parts, order)
    kind = flags & 0xFF
    shape = () if kind == _OPAQUE else tuple(_numbers(*_next(parts), order).tolist())
    name = bytes(_next(parts)[1]).decode("ascii")
    if kind in _NUMERIC and not flags & _COMPLEX:
        _check_shape(shape)
        return name, _numbers(*_next(parts), order).reshape(shape, order="F")
    if kind == _CHARS:
        text = _text(*_next(parts), shape, order)
        return name, None if text is None or 0 in shape else np.array([[text]])
    if kind == _CELL:
        _check_shape(shape)
        return name, _words(parts, shape, order)
    return name, None


def _words(parts: Iterator[tuple[int, memoryview]], shape: tuple[int, ...], order: str) -> np.ndarray | None:
    """Return a cell of strings, or None for other contents."""
    words = []
    for kind, body in parts:
        text = None
        if kind == _MATRIX and len(body):
            inner = _elements(body, order)
            if _flags(inner, order) & 0xFF == _CHARS:
                lengths = tuple(_numbers(*_next(inner), order).tolist())
                _next(inner)
                text = _text(*_next(inner), lengths, order)
        if text is None:
            return None
        words.append(text)
    _check_shape((len(words), max(map(len, words), default=0)))  # each string is padded to the longest length
    return np.array(words, dtype=np.str_).reshape(shape, order="F")


def _text(kind: int, data: memoryview, shape: tuple[int, ...], order: str) -> str | None:
    """Return a character array as a string, or None if it has several rows."""
    _check_shape(shape)
    if 0 in shape:
        return ""
    if math.prod(shape[:-1]) != 1:
        return None
    codec = _TEXTS.get(kind)
    if codec is None:
        raise LogError(f"Expected characters, got an element of kind {kind}.")
    suffix = {"<": "-le", ">": "-be"}[order] if codec[-2:] in ("16", "32") else ""
    return bytes(data).decode(codec + suffix, errors="replace")[: shape[-1]]


def _flags(parts: Iterator[tuple[int, memoryview]], order: str) -> int:
    found = _numbers(*_next(parts), order).tolist()
    if len(found) != 2 or found[0] & 0xFF not in _CLASSES:
        raise LogError(f"Expected the class and the flags of a variable, got {found[:2]}.")
    return int(found[0])


def _check_shape(shape: tuple[int, ...]) -> None:
    if not shape or min(shape) < 0:
        raise LogError(f"Expected at least one array dimension and no negative dimension, got {list(shape)[:8]}.")


def _numbers(kind: int, data: memoryview, order: str) -> np.ndarray:
    if kind not in _NUMBERS:
        raise LogError(f"Expected numbers, got an element of kind {kind}.")
    stored = np.frombuffer(data, dtype=np.dtype(order + _NUMBERS[kind]))
    return stored.astype(stored.dtype.newbyteorder("="), copy=False)


def _next(parts: Iterator[tuple[int, memoryview]]) -> tuple[int, memoryview]:
    found = next(parts, None)
    if found is None:
        raise LogError("Expected a complete variable, but the data ended within the variable.")
    return found


def read_mat(path: str | Path, name: str | None = None) -> dict[str, np.ndarray]:
    """Read the real numerical arrays of a ``.mat`` file, by name.

    Text, cells, structs and complex numbers are skipped.

    Parameters
    ----------
    path : MAT file, v5 to v7.3.
    name : read only this variable.

    Raises
    ------
    LogError : the file is not a MAT file, is truncated, or contains no arrays.
    UnknownName : the array does not exist.
    MissingExtra : the file has version 7.3, and h5py is not installed.
    """
    path = Path(path)
    variables, _ = read_variables(path)
    found = {key: array.astype(np.float64) for key, array in variables.items() if array.dtype.kind != "U"}
    if name is not None and name not in found:
        raise UnknownName.among("variable", name, found)
    if not found:
        raise LogError(
            f"Expected arrays in {path}, got none. Save numeric arrays; text, cells and structs are not read."
        )
    return found if name is None else {name: found[name]}


def read_variables(path: Path) -> tuple[dict[str, np.ndarray], list[str]]:
    """Return the real numeric and text arrays of a MAT file by name, and the names of all other variables."""
    try:
        with path.open("rb") as file:
            head = file.read(FIRST)
    except OSError as error:
        raise LogError(f"Expected a MAT file at {path}, got: {error.strerror}.") from None
    if format_of(head) in ("HDF5", "MAT v7.3"):
        h5py = needed("h5py", f"to read {path}, a MAT file of version 7.3", "or save it again with save(..., '-v7')")
        with undamaged(f"MAT file at {path}"), h5py.File(path, "r") as file:
            check_unpacked_size(path, stored_size(h5py, file))
            found = {name: _dataset(item, h5py) for name, item in file.items() if not name.startswith("#")}
    elif head.startswith(b"MATLAB 5.0"):
        try:
            found = variables_in(path.read_bytes())
        except (LogError, ValueError, OverflowError) as error:  # inconsistent sizes, invalid characters
            what = str(error).rstrip(".")
            raise LogError(f"Expected a valid MAT file at {path}, got a corrupt one: {what[:200]}.") from None
        found = {name: value for name, value in found.items() if name and not name.startswith("__")}
    else:
        raise LogError(
            f"Expected a MAT file at {path}, got a file that begins "
            f"with {head[:10]!r}. Save the file from MATLAB with save."
        )
    return {k: v for k, v in found.items() if v is not None}, [k for k, v in found.items() if v is None]


def _dataset(item: Any, h5py: Any) -> np.ndarray | None:
    """Return an array of version 7.3 in MATLAB's orientation."""
    if not isinstance(item, h5py.Dataset) or "MATLAB_empty" in item.attrs:
        return None
    array = item[()]
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "biuf":
        return None
    if item.attrs.get("MATLAB_class", b"double") == b"char":
        codes = array.T.astype("<u2")
        return np.array([[codes.tobytes().decode("utf-16-le")]]) if len(codes) == 1 else None
    return array.T.copy()


LARGEST = 2**31 - 2**16  # bytes per variable, including its header
LONGEST = 59  # characters per name: 63 with the largest suffix
TAKEN = ("t", "units", "names", "armlab")
KEYWORDS = (
    "break", "case", "catch", "classdef", "continue", "else", "elseif", "end", "for", "function", "global", "if",
    "otherwise", "parfor", "persistent", "return", "spmd", "switch", "try", "while",
)  # fmt: skip


def matlab_names(names: Iterable[str]) -> dict[str, str]:
    """Return the variable name of each column: its own name if MATLAB allows it, otherwise a similar name."""
    return distinct({name: _valid(name) for name in names}, TAKEN)


def write_mat(table: Table, file: BinaryIO, progress: Progress) -> None:
    from scipy.io import savemat

    for name in ("t", *table.names):
        if table[name].nbytes > LARGEST:
            raise LogError(
                f"Expected columns below 2 GB for a MAT file of version 5, got {table[name].nbytes / 1e9:.1f} GB in "
                f"{name!r}. To write HDF5, use a name that ends in .h5."
            )
    names = matlab_names(table.names)
    variables: dict[str, Any] = {"t": table.t}
    variables |= {own: _cells(table[name]) for name, own in names.items()}
    variables["units"] = {"t": "s", **{own: table.units[name] for name, own in names.items()}}
    changed = {own: name for name, own in names.items() if own != name}
    if changed:
        variables["names"] = changed
    variables["armlab"] = Description.of(table).json()
    whole = sum(array.nbytes for array in (table.t, *table.values.values()))
    savemat(_Told(file, whole, progress), variables, long_field_names=True, oned_as="column")


def read_mat_table(path: Path, *, raw: bool = False, names: ColumnNames | None = None) -> Table:
    """Return the table in a MAT file, written by `write_mat` or converted by `foreign_table`."""
    found, left_out = read_variables(path)
    text = found.get("armlab")
    if text is None or text.dtype.kind != "U" or text.shape != (1, 1):
        return foreign_table(path, {name: (value, "") for name, value in found.items()}, left_out, raw, names)
    about = of_json(str(text[0, 0]), path)
    of_matlab = matlab_names(about.columns)
    missing = [name for name, own in {"t": "t", **of_matlab}.items() if own not in found]
    if missing:
        raise LogError(f"Expected all variables described in {path}, but {', '.join(missing)} are missing.")
    table = about.table(path, np.ravel(found["t"]), {name: found[own] for name, own in of_matlab.items()})
    return renamed(path, table, names)


def _valid(name: str) -> str:
    """Return a valid MATLAB name; a valid name is unchanged."""
    valid = re.sub(r"\W", "_", name, flags=re.ASCII)
    return (valid if valid[:1].isalpha() and valid not in KEYWORDS else f"x{valid}")[:LONGEST]


def _cells(values: np.ndarray) -> np.ndarray:
    """Return numbers unchanged, and strings as a cell array."""
    if values.dtype.kind != "U":
        return values
    cells = np.empty(values.shape if values.ndim > 1 else (len(values), 1), dtype=object)
    cells[...] = values.astype(object).reshape(cells.shape)
    return cells


class _Told:
    """File wrapper that reports progress for each percent of the bytes written."""

    def __init__(self, file: BinaryIO, whole: int, progress: Progress) -> None:
        self._file, self._whole, self._progress = file, whole, progress
        self._done = self._told = 0
        self.tell, self.seek = file.tell, file.seek

    def write(self, data: bytes) -> int:
        self._done += memoryview(data).nbytes
        if 100 * (self._done - self._told) >= self._whole:
            self._told = min(self._done, self._whole)
            self._progress(self._told, self._whole, "bytes")
        return self._file.write(data)
