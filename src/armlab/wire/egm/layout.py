"""Where the numbers of an EgmRobot lie: learnt from one packet, used for the next ones of the same shape.

The packets of a session differ in their numbers only. One comparison under a mask says whether all tags, lengths and
states of a datagram are those of the packet that was learnt from; one `struct` call then reads its numbers, at a third
of the time that a parser and its objects take.
"""

from __future__ import annotations

from collections.abc import Sequence
from operator import itemgetter
from struct import Struct
from typing import Any

from armlab.wire.egm import armlab_egm_pb2 as pb
from armlab.wire.egm.force import is_layout_of_rw7

__all__ = ["Layout", "Places", "find_places"]

_LONGEST = 2048  # bytes that are looked through; RobotWare 7 with everything that it can send has 1110
_VARINT, _EIGHT_BYTES, _BYTES, _FOUR_BYTES = 0, 1, 2, 5
_STATES = {
    "header.mtype",
    "motorState.state",
    "mciState.state",
    "mciConvergenceMet",
    "rapidExecState.state",
    "rapidFromRobot.digVal",
    "researchState.order",
}  # integers that belong to the shape: when one changes the layout is learnt anew


class Places:
    """What `find_places` found in a message.

    Attributes
    ----------
    mask : 1 for each bit that belongs to the shape.
    doubles : offsets of the values of each field, by its name with dots. integers : (start, stop) of each varint.
    """

    def __init__(self, size: int) -> None:
        self.mask = bytearray(b"\xff" * size)
        self.doubles: dict[str, list[int]] = {}
        self.integers: dict[str, tuple[int, int]] = {}

    def walk(self, data: bytes, at: int, stop: int, message: Any, prefix: str) -> None:
        """Look through one message, given by its descriptor, and those inside it."""
        while at < stop:
            tag, at = _varint(data, at)
            field = message.fields_by_number.get(tag >> 3)
            at = self._field(data, at, tag & 7, field, prefix + field.name if field else "")
        if at != stop:
            raise ValueError

    def _field(self, data: bytes, at: int, kind: int, field: Any, name: str) -> int:
        """Note the field whose tag ends at `at`, and return where it ends."""
        if kind == _VARINT:
            end = _varint(data, at)[1]
            if name not in _STATES:
                self.mask[at:end] = b"\x80" * (end - at)  # whether another byte follows is part of the shape
            self.integers[name] = at, end
            return end
        if kind not in (_EIGHT_BYTES, _BYTES, _FOUR_BYTES):
            raise ValueError
        length, at = _varint(data, at) if kind == _BYTES else ({_EIGHT_BYTES: 8, _FOUR_BYTES: 4}[kind], at)
        end = at + length
        is_double = field is not None and field.type == field.TYPE_DOUBLE
        if kind == _BYTES and name == "measuredForce":
            is_rw7 = is_layout_of_rw7(data[at:end])
            self.walk(data, at, end, (pb.EgmForceRw7 if is_rw7 else pb.EgmForceRw6).DESCRIPTOR, name + ".")
        elif kind == _BYTES and field is not None and field.message_type is not None:
            self.walk(data, at, end, field.message_type, name + ".")
        else:
            self.mask[at:end] = bytes(length)
            if is_double and kind in (_EIGHT_BYTES, _BYTES):
                self.doubles.setdefault(name, []).extend(range(at, end, 8))
        return end


def find_places(data: bytes) -> Places | None:
    """Return where the numbers of an EgmRobot lie, None for what is too long or not laid out as usual.

    Parameters
    ----------
    data : one datagram.
    """
    if len(data) > _LONGEST:
        return None
    places = Places(len(data))
    try:
        places.walk(data, 0, len(data), pb.EgmRobot.DESCRIPTOR, "")
    except (ValueError, IndexError):
        return None
    return places


class Layout:
    """Reads datagrams of one shape.

    Parameters
    ----------
    data : the datagram that has it. places : of its numbers.
    offsets : of the doubles to read, in the order wanted; -1 reads 0.
    integers : names of the integers to read, 0 when absent.
    """

    def __init__(self, data: bytes, places: Places, offsets: Sequence[int], integers: Sequence[str]) -> None:
        self._mask = int.from_bytes(places.mask, "little")
        self._shape = int.from_bytes(data, "little") & self._mask
        found = sorted({at for at in offsets if at >= 0})
        steps, at = [], 0
        for offset in found:
            steps.append(f"{offset - at}xd")
            at = offset + 8
        self._unpack = Struct(f"<{''.join(steps)}{len(data) - at}x").unpack
        where = {offset: k for k, offset in enumerate(found)}
        self._pick = itemgetter(*(where.get(offset, len(found)) for offset in offsets))
        self._count = len(integers)
        spans = [(k, *places.integers[name]) for k, name in enumerate(integers) if name in places.integers]
        self._spans = tuple((k, slice(stop - 1, start - 1, -1)) for k, start, stop in spans)

    def read(self, data: bytes) -> tuple[tuple[float, ...], list[int]] | None:
        """Return the doubles and the integers of a datagram of the same length, None when it has another shape.

        Parameters
        ----------
        data : the datagram.
        """
        if int.from_bytes(data, "little") & self._mask != self._shape:
            return None
        integers = [0] * self._count
        for k, span in self._spans:
            value = 0
            for byte in data[span]:
                value = value << 7 | byte & 0x7F
            integers[k] = value
        return self._pick((*self._unpack(data), 0.0)), integers


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """Return the integer at an offset and where it ends."""
    value = shift = 0
    while True:
        byte = data[at]
        value |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return value, at
