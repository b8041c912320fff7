"""`RowColumns`: rows of a bridge as the rows of a recording, both bytes, without taking numbers out."""

from __future__ import annotations

import math
import struct

from armlab.bridge.servers.row import MAGIC, RowField, RowSchema
from armlab.errors import LinkError
from armlab.log.recording.rows import SELDOM, RowLayout, Slot

__all__ = ["RowColumns", "stamp_of", "tick_of"]

_WALL = slice(32, 40)  # of a row's head
_PAIR = struct.Struct("<qq")


class RowColumns:
    """Positions of the columns of one robot's recording in the rows of its bridge.

    Columns that the rows lack, such as commands to external axes, are missing in the recording.
    """

    def __init__(self, schema: RowSchema, robot: str, layout: RowLayout) -> None:
        if f"{robot}.tick" not in schema.fields:
            raise LinkError(f"Expected rows with the ticks of {robot}, got those of {', '.join(schema.robots)}.")
        self._id, self._size = schema.id, schema.size
        self._places: list[slice | bytes] = []
        for name, slot in layout.slots.items():
            if name == SELDOM[0]:
                break  # from here on a row may end
            if name == "stamp_ns":
                self._add(_WALL)
                continue
            field = schema.fields.get(f"{robot}.{name}")
            self._add(slot.nothing if field is None else _place(field, slot))

    def packed(self, data: bytes) -> bytes:
        """Return the recording's row for a row of the bridge; raise LinkError for another schema."""
        if len(data) != self._size or data[:4] != MAGIC or data[8:16] != self._id:
            raise LinkError(f"Expected a row of {self._size} bytes and schema {self._id.hex()}, got {len(data)} bytes.")
        return b"".join([place if isinstance(place, bytes) else data[place] for place in self._places])

    def _add(self, place: slice | bytes) -> None:
        """Add a piece; what follows the last one in the row is one piece with it."""
        last = self._places[-1] if self._places else b""
        if isinstance(place, bytes) and isinstance(last, bytes) and self._places:
            self._places[-1] = last + place
        elif isinstance(place, slice) and isinstance(last, slice) and last.step is place.step is None:
            if last.stop == place.start:
                self._places[-1] = slice(last.start, place.stop)
            else:
                self._places.append(place)
        else:
            self._places.append(place)


def stamp_of(packed: bytes) -> int:
    """Return the wall clock of a row of a recording [ns]."""
    return _PAIR.unpack_from(packed)[0]


def tick_of(packed: bytes) -> int:
    """Return the tick of a row of a recording."""
    return _PAIR.unpack_from(packed)[1]


def _place(field: RowField, slot: Slot) -> slice:
    """Return where the values are; of a flag the lowest byte, -1 being the 255 that means missing."""
    if field.shape != slot.column.shape or field.type == "text":
        raise LinkError(f"Expected {field.name} of shape {slot.column.shape} in the rows, got {field.shape}.")
    stop = field.offset + 8 * math.prod(field.shape)
    return slice(field.offset, stop, 8 if slot.dtype == "u1" else None)
