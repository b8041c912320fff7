"""Where the numbers of a message lie: learnt from one, used for the next ones of the same shape.

The packets of a session differ in their numbers only. One comparison under a mask says whether all tags, lengths and
states of a datagram are those of the packet that was learnt from; its numbers are then read (`kernels.EgmReader`) at a
fifth of the time that a parser and its objects take. Replies are written (`kernels.EgmWriter`) in the same way.
"""

from __future__ import annotations

from typing import Any

from armlab.wire.egm import armlab_egm_pb2 as pb
from armlab.wire.egm.force import is_layout_of_rw7

__all__ = ["Places", "find_places"]

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
        if end > len(data):  # of what a parser has not looked into: nothing of that size is allocated
            raise ValueError
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


def find_places(data: bytes, descriptor: Any = pb.EgmRobot.DESCRIPTOR) -> Places | None:
    """Return where the numbers of a message lie, None for what is too long or not laid out as usual.

    Parameters
    ----------
    data : one datagram. descriptor : of the message, by default an EgmRobot.
    """
    if len(data) > _LONGEST:
        return None
    places = Places(len(data))
    try:
        places.walk(data, 0, len(data), descriptor, "")
    except (ValueError, IndexError):
        return None
    return places


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """Return the integer at an offset and where it ends."""
    value = shift = 0
    while True:
        byte = data[at]
        value |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return value, at
