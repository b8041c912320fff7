"""Messages of one row for other programs (specification; the compiled twin is native/row_messages.cpp)."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

import numpy as np

from armlab.errors import ShapeError
from armlab.kernels._reference.chain import Chain
from armlab.kernels._reference.lie import quaternion_from_matrix

__all__ = ["RowMessages"]

_STAMP = struct.Struct("<iI")
_SECOND = 10**9
_COPIED, _TURNED, _POSE = range(3)
_32 = 0xFFFFFFFF


class RowMessages:
    """Makes messages of a row by patching templates.

    Parameters
    ----------
    head : that every row begins with. size : bytes of a row. clock : place of its stamp (int64, ns).
    topics : (fresh, columns, variants, kind, chain, joints) each.
        fresh : place of an int64; where it is 0, the row has no such message.
        columns : (place in the row, count) each, of float64. One of them is there when none of its numbers is NaN.
        variants : for each set of columns that are there, the first of them the lowest bit: None for no message, or
        (message, stamp, copies). stamp : place of seconds (int32) and nanoseconds (uint32). copies : (place in the
        message, place in the row, count of float64) each.
        kind : 0, the numbers are copied; 1, they are vectors of three in base axes and are turned into axes of the
        tool; 2, the one copy is position xyz and quaternion xyzw of the tool in the base.
        chain, joints : of kinds 1 and 2, the arm and the place of its joints in the row.

    Raises
    ------
    ShapeError : topics that contradict themselves.
    """

    def __init__(self, head: bytes, size: int, clock: int, topics: Sequence[tuple[Any, ...]]) -> None:
        self._head, self._size, self._clock = head, size, clock
        self._topics = [tuple(topic) for topic in topics]
        fits = _inside(clock, 8, size)
        for fresh, columns, variants, kind, chain, joints in self._topics:
            fits = fits and _inside(fresh, 8, size) and all(_inside(at, 8 * count, size) for at, count in columns)
            fits = fits and len(variants) == 1 << len(columns) and kind in (_COPIED, _TURNED, _POSE)
            fits = fits and (kind == _COPIED or _inside(joints, 8 * chain.n, size))
            for message, stamp, copies in (variant for variant in variants if variant is not None):
                fits = fits and _inside(stamp, _STAMP.size, len(message))
                for to, at, count in copies:
                    fits = fits and _inside(to, 8 * count, len(message))
                    fits = fits and (count == 7 if kind == _POSE else _inside(at, 8 * count, size))
                    fits = fits and (kind != _TURNED or count % 3 == 0)
        if not fits:
            raise ShapeError("Expected topics whose places are inside of rows and messages, got others.")

    def of_row(self, row: bytes, wanted: Sequence[int]) -> list[bytes | None]:
        """Return the messages of a row, None for each that it has not.

        Parameters
        ----------
        row : one row. wanted : numbers of topics, from 0.

        Raises
        ------
        ShapeError : a row of another size or with another head, or no such topic.
        """
        if len(row) != self._size or not row.startswith(self._head):
            raise ShapeError(f"Expected a row of {self._size} bytes of this schema, got {len(row)} bytes.")
        if not all(0 <= number < len(self._topics) for number in wanted):
            raise ShapeError(f"Expected numbers of {len(self._topics)} topics, got {list(wanted)}.")
        return [self._message(row, *self._topics[number]) for number in wanted]

    def _message(
        self, row: bytes, fresh: int, columns: Any, variants: Any, kind: int, chain: Chain, joints: int
    ) -> bytes | None:
        if not struct.unpack_from("<q", row, fresh)[0]:
            return None
        there = [not np.isnan(_numbers(row, at, count)).any() for at, count in columns]
        variant = variants[sum(1 << bit for bit, is_there in enumerate(there) if is_there)]
        if variant is None:
            return None
        message, stamp, copies = bytearray(variant[0]), *variant[1:]
        seconds, rest = divmod(struct.unpack_from("<q", row, self._clock)[0], _SECOND)
        struct.pack_into("<II", message, stamp, seconds & _32, rest)
        T = np.eye(4) if kind == _COPIED else chain.forward(_numbers(row, joints, chain.n))
        for to, at, count in copies:
            if kind == _POSE:
                w, x, y, z = quaternion_from_matrix(T[:3, :3])
                values = np.array([*T[:3, 3], x, y, z, w])
            else:
                values = _numbers(row, at, count)
            if kind == _TURNED:
                x, y, z = values.reshape(-1, 3, 1).transpose(1, 0, 2)
                values = x * T[0, :3] + y * T[1, :3] + z * T[2, :3]
            message[to : to + 8 * count] = values.astype("<f8").tobytes()
        return bytes(message)


def _numbers(row: bytes, at: int, count: int) -> np.ndarray:
    return np.frombuffer(row, "<f8", count, at)


def _inside(at: int, count: int, size: int) -> bool:
    return at >= 0 and count >= 0 and at + count <= size
