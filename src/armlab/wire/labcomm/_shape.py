"""The sizes of an array as read, checked before anything is built."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from armlab.errors import LabCommError
from armlab.wire.labcomm._source import Cut
from armlab.wire.labcomm.limits import Limits
from armlab.wire.labcomm.types import Array


class Size(NamedTuple):
    """A size and the position where it was read."""

    size: int
    offset: int


class Shape(NamedTuple):
    """Sizes of all dimensions, number of elements, and where the last size was read (None: all are fixed)."""

    sizes: tuple[int, ...]
    total: int
    last: int | None


def checked_shape(node: Array, read: Sequence[Size], rest: int, wide: bool, limits: Limits) -> Shape:
    """Return the shape of an array of which `rest` bytes may follow."""
    offsets = iter(read)
    sizes, product, seen_zero, last = [], 1, False, None
    for size in node.dims:
        if not size:
            size, last = next(offsets)
            if size > limits.values:
                raise _bad(last, f"a size of at most {limits.values}", size)
        seen_zero = seen_zero or not size
        if not seen_zero:
            product *= size
            if product > limits.values and last is not None:
                raise _bad(last, f"at most {limits.values} elements", product)
        sizes.append(size)
    count = math.prod(sizes)
    if not count and product > limits.empty_rows and last is not None:
        raise _bad(last, f"at most {limits.empty_rows} rows without elements", product)
    smallest = count * (node.elem.size + node.elem.numbers * (4 if wide else 1))
    if smallest > rest:
        if last is None:
            raise Cut
        raise _bad(last, f"elements that fit in the {rest} bytes left in the packet", f"{smallest} bytes")
    return Shape(tuple(sizes), count, last)


def nest(flat: list[Any], sizes: tuple[int, ...]) -> list[Any]:
    """Return the elements as nested lists."""
    if not flat and len(sizes) > 1:
        return [nest(flat, sizes[1:]) for _ in range(sizes[0])]
    for size in reversed(sizes[1:]):
        flat = [flat[start : start + size] for start in range(0, len(flat), size)]
    return flat


def _bad(offset: int, expected: str, got: object) -> LabCommError:
    return LabCommError(f"Expected {expected} in the array at byte {offset}, got {got}.", offset)
