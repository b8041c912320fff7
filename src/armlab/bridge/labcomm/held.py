"""What LabComm's rows take from a row of the loop: `ArmPlaces` of an arm, `SourcePlaces` of a source beside the arms.

One `struct` call reads what is wanted of each: an array for each field would take longer than all the rest of a row.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from struct import Struct
from typing import Any, NamedTuple

from armlab.bridge.labcomm.channels import FusedArm, FusedSource
from armlab.bridge.labcomm.rows import Row
from armlab.bridge.row import clock_ms
from armlab.bridge.row_schema import RowField, RowSchema

__all__ = ["ArmPlaces", "Held", "SourcePlaces"]

_LETTERS = {"float64": "d", "int64": "q"}  # of `struct`
_WANTED = ("fresh", "age", "receive_ns", "robot_ns", "session_t", "q", "qd", "tau")


class Held(NamedTuple):
    """What a row of the loop holds of an arm.

    Attributes
    ----------
    is_fresh : the row is one of this arm. arm : its newest values.
    """

    is_fresh: bool
    arm: FusedArm


class ArmPlaces:
    """Where a row of the loop has what LabComm has of an arm.

    Parameters
    ----------
    schema : of the rows. robot : name of the arm.
    """

    def __init__(self, schema: RowSchema, robot: str) -> None:
        self._name = robot
        self._form, self._wanted = _together([schema.fields[f"{robot}.{name}"] for name in _WANTED])

    def held(self, data: bytes) -> Held | None:
        """Return what a row holds of the arm, None before its first.

        Parameters
        ----------
        data : one row of the schema.
        """
        values: Any = self._form.unpack_from(data)
        fresh, age, receive_ns, robot_ns, session_t, q, qd, tau = [values[place] for place in self._wanted]
        tm = clock_ms(robot_ns, session_t)
        if tm is None or not math.isfinite(age):
            return None
        return Held(bool(fresh), FusedArm(self._name, receive_ns // 1000, Row(tm, q, qd, tau)))


class SourcePlaces:
    """Where a row of the loop has the values of a source.

    Parameters
    ----------
    schema : of the rows. source : its name.
    """

    def __init__(self, schema: RowSchema, source: str) -> None:
        self._name = source
        fields = [field for field in schema.fields.values() if field.source == source]
        self._form, found = _together(fields)
        self._age = found[[field.name for field in fields].index(f"{source}.age")]

    def held(self, data: bytes, now_ns: int) -> FusedSource | None:
        """Return what the source gave last, None when it was never heard.

        Parameters
        ----------
        data : one row of the schema. now_ns : its wall clock.
        """
        numbers = list(self._form.unpack_from(data))
        age_ns = 1e9 * numbers.pop(self._age)
        if not math.isfinite(age_ns):
            return None
        return FusedSource(self._name, (now_ns - round(age_ns)) // 1000, numbers)


def _together(fields: Sequence[RowField]) -> tuple[Struct, list[Any]]:
    """Return what reads fields of a row in one call, and the index or slice of each in what it gives."""
    text, end, count, found = "<", 0, 0, {}
    for field in sorted(fields, key=lambda one: one.offset):
        many = math.prod(field.shape)
        text += f"{field.offset - end}x{many}{_LETTERS[field.type]}"
        found[field.name] = slice(count, count + many) if field.shape else count
        end, count = field.offset + field.size, count + many
    return Struct(text), [found[field.name] for field in fields]
