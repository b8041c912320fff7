"""The numbers of messages, out of a chunk of an MCAP file (specification; the compiled twin is native/messages.cpp)."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from armlab.errors import ShapeError

__all__ = ["MessageCopier"]

_RECORD, _MESSAGE = struct.Struct("<BQ"), struct.Struct("<HIQQ")
_MESSAGE_KIND = 5

Pairs = Sequence[tuple[int, int]]


@dataclass(frozen=True, slots=True)
class _Channel:
    example: bytes
    fixed: Pairs
    places: Pairs
    sequence: np.ndarray
    log_ns: np.ndarray
    columns: Sequence[np.ndarray]

    def __post_init__(self) -> None:
        size = len(self.example)
        for start, stop in (*self.fixed, *self.places):
            if not 0 <= start <= stop <= size:
                raise ShapeError(f"Expected places in a message of {size} bytes, got {start} to {stop}.")
        if len(self.columns) != len(self.places):
            raise ShapeError(f"Expected an array for each of {len(self.places)} places, got {len(self.columns)}.")
        widths = [4, 8, *(stop - start for start, stop in self.places)]
        for array, width in zip((self.sequence, self.log_ns, *self.columns), widths, strict=True):
            rows = len(self.sequence)
            if not (array.flags.c_contiguous and array.flags.writeable) or (len(array), array.nbytes) != (
                rows,
                rows * width,
            ):
                raise ShapeError(
                    f"Expected writable arrays with a row of {width} bytes for every message, got another."
                )

    def matches(self, message: memoryview) -> bool:
        """Tell whether a message is as long as the example, with the same bytes in the fixed places."""
        example = self.example
        return len(message) == len(example) and all(message[a:b] == example[a:b] for a, b in self.fixed)


class MessageCopier:
    """Copies the numbers of messages into the rows of arrays, channel by channel, where all are laid out as expected.

    Several threads may copy at the same time, into different rows.

    Parameters
    ----------
    channels : of each its number; the bytes of an example message; pairs (start, stop) of the bytes in it that all
        messages have; pairs of the numbers to copy; and the arrays to write into, with a row for every message of the
        file: sequence numbers (N,) uint32, log times (N,) int64, and one of N rows for every pair of numbers.

    Raises
    ------
    ShapeError : places outside the message; arrays that are read-only, not contiguous or of another size.
    """

    def __init__(self, channels: Sequence[tuple[Any, ...]]) -> None:
        self._channels = [_Channel(*about) for _, *about in channels]
        self._slots = {number: slot for slot, (number, *_) in enumerate(channels)}

    def copy(self, data: bytes | memoryview, first: Sequence[int], count: Sequence[int]) -> list[bool]:
        """Return of which channels all messages are copied; the rows of the others hold nothing of use.

        Parameters
        ----------
        data : the records of a chunk, unpacked.
        first, count : of each channel the row of its first message, and how many it must have; -1 leaves it out.

        Raises
        ------
        ShapeError : rows that the arrays do not have.
        """
        if not len(first) == len(count) == len(self._channels):
            raise ShapeError(f"Expected a first row and a count for each of {len(self._channels)} channels.")
        for channel, row, wanted in zip(self._channels, first, count, strict=True):
            if wanted >= 0 and not 0 <= row <= row + wanted <= len(channel.sequence):
                raise ShapeError(f"Expected rows from 0 to {len(channel.sequence)}, got {wanted} from {row}.")
        fits = [wanted >= 0 for wanted in count]
        found = self._found(memoryview(data), fits, count)
        for slot, (channel, row, messages) in enumerate(zip(self._channels, first, found, strict=True)):
            fits[slot] = fits[slot] and len(messages) == count[slot]
            if fits[slot] and messages:
                _put(channel, row, messages)
        return fits

    def _found(self, view: memoryview, fits: list[bool], count: Sequence[int]) -> list[list[memoryview]]:
        """Return the messages of each channel, as far as they are as expected."""
        found: list[list[memoryview]] = [[] for _ in self._channels]
        at = 0
        while at + _RECORD.size <= len(view):
            kind, length = _RECORD.unpack_from(view, at)
            start, at = at + _RECORD.size, at + _RECORD.size + length
            if at > len(view):
                break
            if kind != _MESSAGE_KIND or length < _MESSAGE.size:
                continue
            slot = self._slots.get(view[start] | view[start + 1] << 8, -1)
            if slot >= 0 and fits[slot]:
                matches = self._channels[slot].matches(view[start + _MESSAGE.size : at])
                fits[slot] = matches and len(found[slot]) < count[slot]
                found[slot].append(view[start:at])
        return found


def _put(channel: _Channel, row: int, messages: Sequence[memoryview]) -> None:
    block = np.frombuffer(b"".join(messages), dtype=np.uint8).reshape(len(messages), -1)
    places = [(2, 6), (6, 14), *((_MESSAGE.size + start, _MESSAGE.size + stop) for start, stop in channel.places)]
    for array, (start, stop) in zip((channel.sequence, channel.log_ns, *channel.columns), places, strict=True):
        rows = array[row : row + len(messages)]
        rows[...] = block[:, start:stop].copy().view(array.dtype).reshape(rows.shape)
