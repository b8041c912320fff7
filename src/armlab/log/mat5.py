"""Arrays of a MAT file of version 5 to 7.2, every size checked before it is used.

SciPy trusts the sizes in a file: a damaged one can end the process. The format: MATLAB, "MAT-File Level 5 File Format".
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator

import numpy as np

from armlab.errors import LogError

__all__ = ["variables_in"]

_HEADER = 128  # bytes of text, version and byte order before the first element
_MATRIX, _COMPRESSED = 14, 15  # kinds of elements
_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_TEXTS = {1: "ascii", 2: "ascii", 4: "utf-16", 16: "utf-8", 17: "utf-16", 18: "utf-32"}
_CELL, _CHARS, _OPAQUE = 1, 4, 17  # classes of matrices
_NUMERIC = range(6, 16)
_CLASSES = range(1, 18)
_COMPLEX = 0x0800
_UNPACKED, _RATIO = 1 << 26, 200  # bytes of any file; above that, for each of its own


def variables_in(data: bytes) -> dict[str, np.ndarray | None]:
    """Return the variables of a file: real numbers as stored, texts and cells of texts, None for others.

    Arrays share the memory of the file and cannot be written to.

    Parameters
    ----------
    data : the whole file.

    Raises
    ------
    LogError : it is damaged, or unpacks to more than 64 MiB and 200 times its size. ValueError : it is damaged.
    """
    order = {b"IM": "<", b"MI": ">"}.get(data[126:_HEADER])
    if order is None:
        raise LogError("Expected the byte order IM or MI, got another.")
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
    """Yield kind and data of each element; it begins at a multiple of 8 bytes unless it is compressed."""
    at = 0
    while at < len(view):
        if len(view) - at < 8:
            raise LogError("Expected an element of 8 bytes or more, got the end of the file.")
        kind, size = struct.unpack_from(order + "II", view, at)
        start, end = at + 8, at + 8 + size
        if kind >> 16:  # up to 4 bytes of data within the 8 of the tag
            kind, size = kind & 0xFFFF, kind >> 16
            start, end = at + 4, at + 4 + size
            if size > 4:
                raise LogError(f"Expected a small element of up to 4 bytes, got {size}.")
        if end > len(view):
            raise LogError(f"Expected an element of {size} bytes, got {len(view) - start}.")
        yield kind, view[start:end]
        at = end if kind == _COMPRESSED else end + -end % 8


def _unpacked(body: memoryview, order: str, most: int) -> tuple[int, memoryview]:
    """Return kind and data of the element in compressed data, which begins with its size."""
    packed = zlib.decompressobj()
    try:
        kind, size = struct.unpack(order + "II", packed.decompress(body, 8))
        if size > most:
            raise LogError(
                f"Expected variables of at most {most} bytes in a file of this size, got {size}. Save it from MATLAB "
                "with save(..., '-nocompression')."
            )
        data = packed.decompress(packed.unconsumed_tail, size + 1)
    except (zlib.error, struct.error) as error:
        raise LogError(f"Expected compressed data, got: {error}.") from None
    if len(data) != size or not packed.eof:
        raise LogError(f"Expected {size} bytes of compressed data, got others.")
    return kind, memoryview(data)


def _matrix(body: memoryview, order: str) -> tuple[str, np.ndarray | None]:
    """Return the name and the values of a variable."""
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
    """Return a cell of texts; None of one that holds something else."""
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
    _check_shape((len(words), max(map(len, words), default=0)))  # each takes the room of the longest
    return np.array(words, dtype=np.str_).reshape(shape, order="F")


def _text(kind: int, data: memoryview, shape: tuple[int, ...], order: str) -> str | None:
    """Return a text in one row; None of several rows."""
    _check_shape(shape)
    if 0 in shape:
        return ""
    if math.prod(shape[:-1]) != 1:
        return None
    codec = _TEXTS.get(kind)
    if codec is None:
        raise LogError(f"Expected letters, got an element of kind {kind}.")
    suffix = {"<": "-le", ">": "-be"}[order] if codec[-2:] in ("16", "32") else ""
    return bytes(data).decode(codec + suffix, errors="replace")[: shape[-1]]


def _flags(parts: Iterator[tuple[int, memoryview]], order: str) -> int:
    """Return the class and the flags of a variable."""
    found = _numbers(*_next(parts), order).tolist()
    if len(found) != 2 or found[0] & 0xFF not in _CLASSES:
        raise LogError(f"Expected the class and the flags of a variable, got {found[:2]}.")
    return int(found[0])


def _check_shape(shape: tuple[int, ...]) -> None:
    if not shape or min(shape) < 0:
        raise LogError(f"Expected the sizes of an array, got {list(shape)[:8]}.")


def _numbers(kind: int, data: memoryview, order: str) -> np.ndarray:
    if kind not in _NUMBERS:
        raise LogError(f"Expected numbers, got an element of kind {kind}.")
    stored = np.frombuffer(data, dtype=np.dtype(order + _NUMBERS[kind]))
    return stored.astype(stored.dtype.newbyteorder("="), copy=False)


def _next(parts: Iterator[tuple[int, memoryview]]) -> tuple[int, memoryview]:
    found = next(parts, None)
    if found is None:
        raise LogError("Expected the rest of a variable, got its end.")
    return found
