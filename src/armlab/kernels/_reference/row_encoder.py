"""Rows of a recording as records of MCAP (specification; the compiled twin is native/row_encoder.cpp)."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from math import sqrt
from typing import Any

from armlab.errors import ShapeError

__all__ = ["RowEncoder"]

_HEAD = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
_ENTRY = struct.Struct("<QQ")
_STAMP = struct.Struct("<II")
_ROW = struct.Struct("<qI")  # a row begins with its stamp [ns] and the number of its tick
_MESSAGE, _ENCAPSULATION, _POSE = 5, 4, 56
_32, _64 = 0xFFFFFFFF, 0xFFFFFFFFFFFFFFFF  # a clock that is out of its mind is written as far as it fits


class RowEncoder:
    """Makes the messages of rows by patching templates, with their records and index entries.

    Parameters
    ----------
    topics : (channel, always, columns, variants, is_pose) each.
        always : each row has this message, not only those with one of its columns.
        columns : (start, nothing, optional) each: where a column begins in the row, the bytes that stand for missing,
        and whether messages without it have a template of their own.
        variants : (message, copies) for each set of optional columns that are there, the first of them the lowest bit;
        copies : (place in the message, place in the row, bytes) each. The message has a stamp behind its encapsulation.
        is_pose : the one copy writes position xyz and quaternion xyzw of the homogeneous matrix in the row.

    Raises
    ------
    ShapeError : topics that contradict themselves.
    """

    def __init__(self, topics: Sequence[tuple[Any, ...]]) -> None:
        self._topics = []
        for channel, always, columns, variants, is_pose in topics:
            if len(variants) != 1 << sum(optional for _, _, optional in columns):
                raise ShapeError(f"Expected a template for each set of optional columns, got {len(variants)}.")
            for message, copies in variants:
                _check(len(message), copies, is_pose)
            self._topics.append((channel, always, columns, [(bytearray(m), copies) for m, copies in variants], is_pose))

    def encode(
        self, rows: Sequence[bytes], first: int | None = None, at: int = 0
    ) -> tuple[bytes, dict[int, bytes], int, int]:
        """Return records, index entries by channel, and the earliest and the latest stamp [ns].

        Parameters
        ----------
        rows : at least one. first : sequence number of the first row, counted on; None takes those of the ticks.
        at : place of the first record in the chunk.

        Raises
        ------
        ShapeError : no row, or one that is too short for its columns.
        """
        if not rows:
            raise ShapeError("Expected at least one row, got none.")
        data, entries, stamps = bytearray(), {topic[0]: bytearray() for topic in self._topics}, []
        for number, row in enumerate(rows):
            if len(row) < _ROW.size + 4:
                raise _too_short(_ROW.size + 4, row)
            stamp, tick = _ROW.unpack_from(row)
            sequence = tick if first is None else (first + number) & _32
            stamps.append(stamp)
            for channel, always, columns, variants, is_pose in self._topics:
                present = [row[start : start + len(nothing)] not in (nothing, b"") for start, nothing, _ in columns]
                if not (always or any(present)):
                    continue
                optional = [there for there, column in zip(present, columns, strict=True) if column[2]]
                message, copies = variants[sum(there << bit for bit, there in enumerate(optional))]
                _STAMP.pack_into(message, _ENCAPSULATION, stamp // 10**9 & _32, stamp % 10**9)
                for to, start, count in copies:
                    if start + (128 if is_pose else count) > len(row):
                        raise _too_short(start + (128 if is_pose else count), row)
                    message[to : to + count] = _pose(row, start) if is_pose else row[start : start + count]
                time, length = stamp & _64, _HEAD.size - 9 + len(message)
                entries[channel] += _ENTRY.pack(time, at + len(data))
                data += _HEAD.pack(_MESSAGE, length, channel, sequence, time, time) + message
        return (
            bytes(data),
            {channel: bytes(made) for channel, made in entries.items() if made},
            min(stamps),
            max(stamps),
        )


def _check(size: int, copies: Sequence[tuple[int, int, int]], is_pose: bool) -> None:
    inside = all(to >= 0 and start >= 0 and count >= 0 and to + count <= size for to, start, count in copies)
    if size < _ENCAPSULATION + _STAMP.size or not inside or (is_pose and [c for _, _, c in copies] != [_POSE]):
        raise ShapeError("Expected copies inside of the message, of a pose the one of its 7 numbers, got others.")


def _too_short(size: int, row: bytes) -> ShapeError:
    return ShapeError(f"Expected a row of {size} bytes or more, got {len(row)}.")


def _pose(row: bytes, start: int) -> bytes:
    """Return position xyz and quaternion xyzw of a pose in a row; w is not negative."""
    r = struct.unpack_from("<16d", row, start)
    # Shepperd's method: divide by the largest of the four components
    squares = (r[0] - r[5] - r[10], r[5] - r[0] - r[10], r[10] - r[0] - r[5], r[0] + r[5] + r[10])
    largest = max(range(4), key=squares.__getitem__)
    big = sqrt(1.0 + squares[largest]) / 2.0
    s = 0.25 / big
    xy, xz, yz = (r[4] + r[1]) * s, (r[8] + r[2]) * s, (r[9] + r[6]) * s
    xw, yw, zw = (r[9] - r[6]) * s, (r[2] - r[8]) * s, (r[4] - r[1]) * s
    x, y, z, w = ((big, xy, xz, xw), (xy, big, yz, yw), (xz, yz, big, zw), (xw, yw, zw, big))[largest]
    sign = -1.0 if w < 0.0 else 1.0
    return struct.pack("<7d", r[3], r[7], r[11], sign * x, sign * y, sign * z, sign * w)
