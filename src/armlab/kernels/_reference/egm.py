"""EGM datagrams read and written where the numbers of one like them lay (specification; compiled twin: native/egm.cpp).

The packets of a session differ in their numbers only. One comparison under a mask says whether all tags, lengths and
states of a datagram are those of the one that was learnt from; then its numbers are picked from where they lie.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import nan
from struct import pack_into, unpack_from
from typing import Any

import numpy as np

from armlab.errors import ShapeError

__all__ = ["EgmReader", "EgmWriter"]

_POSE, _MATRIX = 7, 16
_INTEGERS = 6
_UINT32, _UINT64 = 2**32 - 1, 2**64 - 1
_MOST = 1e9  # degrees or mm: no arm is there, and differences of larger ones would not be finite
_MAX_SECONDS, _MAX_MICROSECONDS = 9_000_000_000, 10**9  # a later clock does not fit int64 nanoseconds


class EgmReader:
    """Makes a packet of the numbers of an EgmRobot, and finds them in datagrams that look like one that is known.

    The numbers are in the order that `scale` has, then the utilization, then x, y, z [mm] and the quaternion u0 to u3
    of the pose. The values are ``numbers * scale``, and the pose as the rows of a matrix [m], which is NaN for a
    quaternion without a usable norm. The integers are the sequence number, tm, the seconds and microseconds of the
    robot's clock, the monotonic clock and the depth of the queue.

    Parameters
    ----------
    kind : named tuple to make. fixed : its fields that do not change, None where another goes.
    arrays : (field, start, stop) of each field that is a part of the values. matrix : field of the pose.
    scalars : fields of the sequence number, tm, the robot's clock [ns], utilization, the monotonic clock and the depth
        of the queue, -1 where the fixed one stays.
    scale : SI per wire unit, NaN for what is absent; the last 16 stand for the matrix.
    finite : (start, stop) of numbers without which there is no packet: finite, and no larger than 1e9.

    Raises
    ------
    ShapeError : fields or numbers that do not exist.
    """

    def __init__(
        self,
        kind: Any,
        fixed: tuple[Any, ...],
        arrays: Sequence[tuple[int, int, int]],
        matrix: int,
        scalars: Sequence[int],
        scale: np.ndarray,
        finite: Sequence[tuple[int, int]],
    ) -> None:
        self._kind, self._fixed, self._arrays, self._matrix = kind, fixed, tuple(arrays), matrix
        self._scalars, self._finite = tuple(scalars), tuple(finite)
        self._scale = np.array(scale[:-_MATRIX])
        self._count = len(scale) - _MATRIX + 1 + _POSE
        fields = range(len(fixed))
        fits = matrix in fields and len(scalars) == _INTEGERS and len(scale) >= _MATRIX
        fits &= all(f in fields and 0 <= a <= b <= len(self._scale) for f, a, b in arrays)
        fits &= all(field == -1 or field in fields for field in scalars)
        if not fits or not all(0 <= a <= b <= self._count for a, b in finite):
            raise ShapeError("Expected a named tuple, and fields and numbers of it, got others.")
        self._size = -1

    def learn(self, data: bytes, mask: bytes, offsets: Sequence[int], spans: Sequence[tuple[int, int]]) -> None:
        """Take a datagram as the example of those that `read` reads.

        Parameters
        ----------
        data : the datagram. mask : 1 for each bit that is the same in all of them.
        offsets : of the numbers, -1 for one that is absent. spans : (start, stop) of the integers, empty when absent.

        Raises
        ------
        ShapeError : outside the datagram, or of another number.
        """
        fits = len(mask) == len(data) and len(offsets) == self._count and len(spans) == _INTEGERS
        if not fits or not _within(offsets, spans, len(data)):
            raise ShapeError("Expected numbers that lie within the datagram, got others.")
        self._size = len(data)
        self._mask = int.from_bytes(mask, "little")
        self._shape = int.from_bytes(data, "little") & self._mask
        self._offsets = tuple(offsets)
        self._spans = tuple(spans)

    def read(self, data: bytes) -> Any | None:
        """Return the packet, None for a datagram that looks otherwise or lacks such a number.

        Parameters
        ----------
        data : one datagram.
        """
        if len(data) != self._size or int.from_bytes(data, "little") & self._mask != self._shape:
            return None
        integers = []
        for start, stop in self._spans:
            value = 0
            for at in range(stop - 1, start - 1, -1):
                value = value << 7 | data[at] & 0x7F
            integers.append(value)
        return self.packet([_double(data, at) if at >= 0 else 0.0 for at in self._offsets], integers)

    def packet(self, numbers: Sequence[float], integers: Sequence[int]) -> Any | None:
        """Return the packet, None when a number that must be finite is not, or is too large.

        Parameters
        ----------
        numbers, integers : see the class, 0 for what is absent.

        Raises
        ------
        ShapeError : too few or too many.
        """
        if len(numbers) != self._count or len(integers) != _INTEGERS:
            raise ShapeError(
                f"Expected {self._count} numbers and {_INTEGERS} integers, got {len(numbers)} and {len(integers)}."
            )
        if not all(abs(x) <= _MOST for start, stop in self._finite for x in numbers[start:stop]):
            return None
        with np.errstate(invalid="ignore", over="ignore"):  # a signalling NaN, or 1e308 degrees, from the wire
            scaled = np.array(numbers[: -_POSE - 1]) * self._scale
        values = np.concatenate((scaled, _matrix(numbers[-_POSE:])))
        values.setflags(write=False)
        made = list(self._fixed)
        for field, start, stop in self._arrays:
            made[field] = values[start:stop]
        made[self._matrix] = values[-_MATRIX:].reshape(4, 4)
        seqno, tm, seconds, microseconds, mono, queue = (value & _UINT64 for value in integers)
        counts = seconds < _MAX_SECONDS and microseconds < _MAX_MICROSECONDS
        robot_ns = seconds * 10**9 + microseconds * 1000 if counts else 0
        scalars = seqno & _UINT32, tm & _UINT32, robot_ns, float(numbers[-_POSE - 1]), mono, queue & _UINT32
        for field, value in zip(self._scalars, scalars, strict=True):
            if field >= 0:
                made[field] = value
        return tuple.__new__(self._kind, made)


class EgmWriter:
    """Writes a datagram by replacing the numbers of an example.

    Parameters
    ----------
    example : the datagram. offsets : of each number, -1 for one that is not sent. divisors : SI per wire unit of each.
    spans : (start, stop) of each integer.

    Raises
    ------
    ShapeError : offsets outside the example, another number of divisors.
    """

    def __init__(
        self, example: bytes, offsets: Sequence[int], divisors: np.ndarray, spans: Sequence[tuple[int, int]]
    ) -> None:
        if np.shape(divisors) != (len(offsets),):
            raise ShapeError(f"Expected {len(offsets)} divisors, got shape {np.shape(divisors)}.")
        if not _within(offsets, spans, len(example)):
            raise ShapeError("Expected numbers that lie within the datagram, got others.")
        self._example, self._offsets, self._divisors = example, tuple(offsets), divisors
        self._spans = tuple(spans)

    def write(self, arrays: tuple[np.ndarray, ...], integers: tuple[int, ...]) -> bytes | None:
        """Return the datagram, None when an integer takes another number of bytes than in the example.

        Parameters
        ----------
        arrays : SI values, as many as there are offsets together. integers : one for each span.

        Raises
        ------
        ShapeError : others.
        """
        sizes = sum(map(len, arrays)), len(integers)
        if sizes != (len(self._offsets), len(self._spans)):
            raise ShapeError(
                f"Expected {len(self._offsets)} numbers and {len(self._spans)} integers, got others in {len(arrays)} "
                f"arrays and {len(integers)} integers."
            )
        out = bytearray(self._example)
        for at, value in zip(self._offsets, (np.concatenate(arrays) / self._divisors).tolist(), strict=True):
            if at >= 0:
                pack_into("<d", out, at, value)
        for (start, stop), integer in zip(self._spans, integers, strict=True):
            found = _varint(integer & _UINT64)
            if len(found) != stop - start:
                return None
            out[start:stop] = found
        return bytes(out)


def _within(offsets: Sequence[int], spans: Sequence[tuple[int, int]], size: int) -> bool:
    inside = all(at == -1 or 0 <= at <= size - 8 for at in offsets)
    return inside and all(0 <= start <= stop <= size for start, stop in spans)


def _double(data: bytes, at: int) -> float:
    return unpack_from("<d", data, at)[0]


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes((*out, value))


def _matrix(pose: Sequence[float]) -> tuple[float, ...]:
    """Return the 16 values, row by row, of a matrix [m]; the quaternion is normalised."""
    x, y, z, a, b, c, d = pose
    norm = a * a + b * b + c * c + d * d
    if not 1e-12 < norm < 1e12:  # also NaN
        return (nan,) * _MATRIX
    s = 2.0 / norm
    b2, c2, d2 = s * b * b, s * c * c, s * d * d
    bc, bd, cd = s * b * c, s * b * d, s * c * d
    ab, ac, ad = s * a * b, s * a * c, s * a * d
    return (
        1.0 - c2 - d2, bc - ad, bd + ac, 1e-3 * x,
        bc + ad, 1.0 - b2 - d2, cd - ab, 1e-3 * y,
        bd - ac, cd + ab, 1.0 - b2 - c2, 1e-3 * z,
        0.0, 0.0, 0.0, 1.0,
    )  # fmt: skip
