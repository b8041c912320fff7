"""Instances of a class with slots, without its __init__ (specification; the compiled twin is native/records.cpp)."""

from __future__ import annotations

from collections.abc import Sequence
from types import MemberDescriptorType
from typing import Any

from armlab.errors import ShapeError

__all__ = ["RecordMaker"]


class RecordMaker:
    """Makes frozen dataclasses with slots of values that are known to be right: their own way takes ten times as long.

    Parameters
    ----------
    kind : the class. names : of its slots, in the order of the values; all, or the others stay unset.

    Raises
    ------
    ShapeError : a name that is no slot.
    """

    def __init__(self, kind: type, names: Sequence[str]) -> None:
        for name in names:
            if not isinstance(getattr(kind, name, None), MemberDescriptorType):
                raise ShapeError(f"Expected slots of the class, got {name}.")
        self._kind, self._setters = kind, [getattr(kind, name).__set__ for name in names]

    def make(self, values: tuple[Any, ...]) -> Any:
        """Return an instance.

        Parameters
        ----------
        values : of the slots.

        Raises
        ------
        ShapeError : too few or too many.
        """
        if len(values) != len(self._setters):
            raise ShapeError(f"Expected one value for each of {len(self._setters)} slots, got {len(values)}.")
        made = object.__new__(self._kind)
        for put, value in zip(self._setters, values, strict=True):
            put(made, value)
        return made
