"""What a decoder finds in a stream: one event per packet, in order."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

from armlab.wire.labcomm.dialects import Notes
from armlab.wire.labcomm.types import Type

__all__ = ["Binding", "Definition", "Event", "Other", "Pragma", "Sample", "Unknown", "Version"]

Kind = Literal["sample", "ref", "type"]


class Version(NamedTuple):
    """VERSION: the announced text."""

    text: str


class Definition(NamedTuple):
    """SAMPLE_DEF, SAMPLE_REF or TYPE_DEF.

    Attributes
    ----------
    kind : "sample", "ref" or "type". index, name, type : as defined. notes : of the name, dialect 2014i only.
    """

    kind: Kind
    index: int  # pyright: ignore[reportIncompatibleMethodOverride]
    name: str
    type: Type
    notes: Notes = ()


class Binding(NamedTuple):
    """TYPE_BINDING: index of a sample and of its type, 0 for its flat signature."""

    sample: int
    type: int


class Pragma(NamedTuple):
    """PRAGMA: its kind and its bytes."""

    kind: str
    body: bytes


class Other(NamedTuple):
    """A packet with a reserved tag, skipped."""

    tag: int
    body: bytes


class Sample(NamedTuple):
    """A value.

    Attributes
    ----------
    index, name : of the sample. value : bool, int, float, str, bytes, nested lists, or a dict in the order of fields.
    type : its type tree.
    """

    index: int  # pyright: ignore[reportIncompatibleMethodOverride]
    name: str
    value: Any
    type: Type


class Unknown(NamedTuple):
    """Data of an index that was not defined, skipped."""

    index: int  # pyright: ignore[reportIncompatibleMethodOverride]
    body: bytes


Event = Version | Definition | Binding | Pragma | Other | Sample | Unknown
"""Any event."""
