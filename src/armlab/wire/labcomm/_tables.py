"""What a stream has defined so far."""

from __future__ import annotations

from functools import cached_property

from armlab.errors import LabCommError
from armlab.wire.labcomm._definition import Head
from armlab.wire.labcomm._read import Reader, reader
from armlab.wire.labcomm.events import Definition, Kind
from armlab.wire.labcomm.limits import Limits
from armlab.wire.labcomm.types import SampleType

__all__ = ["Known", "Tables"]


class Known:
    """A sample type and what reads its values, made with the first value: many types are defined and never sent.

    Attributes
    ----------
    index, name, type : as defined. left : values that a packet may hold besides those that every value has.
    read : the reader.
    """

    def __init__(self, definition: Definition, limits: Limits) -> None:
        _, self.index, self.name, self.type, _ = definition
        self.left = limits.values - self.type.values

    @cached_property
    def read(self) -> Reader:
        """What reads a value."""
        return reader(self.type)


class Tables:
    """Samples, references and types by index, and the readers of the samples; dicts, since indices may be sparse."""

    def __init__(self, limits: Limits) -> None:
        self.samples: dict[int, SampleType] = {}
        self.refs: dict[int, SampleType] = {}
        self.types: dict[int, SampleType] = {}
        self.known: dict[int, Known] = {}
        self._limits, self._nodes = limits, 0

    def keep(self, kind: Kind, head: Head, offset: int) -> Definition:
        """Enter a definition; a repeated one costs nothing, another for its index replaces it."""
        table = {"sample": self.samples, "ref": self.refs, "type": self.types}[kind]
        event, entry = Definition(kind, head.index, head.name, head.type, head.notes), SampleType(head.name, head.type)
        old = table.get(head.index)
        if old != entry:
            nodes = self._nodes + head.type.nodes - (0 if old is None else old.type.nodes)
            limits = self._limits
            if (old is None and len(table) >= limits.definitions) or nodes > limits.nodes:
                most = f"at most {limits.definitions} definitions and {limits.nodes} nodes"
                raise LabCommError(f"Expected {most} in a stream, got one more at byte {offset}.", offset)
            self._nodes, table[head.index] = nodes, entry
            if kind == "sample":
                self.known[head.index] = Known(event, limits)
        return event
