"""`Encoder` converts sample types and values to packets; `write_packet` converts a decoded packet back to bytes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from armlab.errors import LabCommError
from armlab.wire.labcomm.types import (
    Binding,
    Definition,
    Dialect,
    Event,
    Other,
    Pragma,
    Sample,
    SampleType,
    Type,
    TypeRef,
    Unknown,
    Version,
    dialect_named,
)
from armlab.wire.labcomm.values import Misfit, Wire, Writer, writer

FIRST_INDEX = 0x40
VERSION, SAMPLE_DEF, SAMPLE_REF, TYPE_DEF, TYPE_BINDING, PRAGMA = 1, 2, 3, 4, 5, 0x3F
_DEFINES = {"sample": SAMPLE_DEF, "ref": SAMPLE_REF, "type": TYPE_DEF}


class Encoder:
    """Encoder of one stream: VERSION, a SAMPLE_DEF before the first value of each type, then data.

    Clients based on any LabComm library can read the stream.

    Parameters
    ----------
    dialect : name of the dialect.
    allow_nul : whether strings may contain NUL, which terminates them in C.
    type_defs : whether a TYPE_BINDING follows each definition, as in the C libraries of 2014 and 2014i.

    Raises
    ------
    UnknownName : if the dialect is unknown.
    LabCommError : if the dialect has no type bindings.
    """

    def __init__(self, dialect: str = "2014v1", allow_nul: bool = False, type_defs: bool = False) -> None:
        self._dialect = dialect_named(dialect)
        if type_defs and dialect not in ("2014", "2014i"):
            raise LabCommError(f"Expected dialect 2014 or 2014i for type bindings, got {dialect}.")
        self._type_defs, self._wire = type_defs, Wire(self._dialect, allow_nul, self.ref_index)
        self._samples: dict[SampleType, int] = {}
        self._refs: dict[SampleType, int] = {}
        self._writers: dict[SampleType, Callable[[Any], bytes]] = {}
        self._last: tuple[SampleType | None, Callable[[Any], bytes]] = None, bytes  # avoids comparing type trees

    @property
    def dialect(self) -> str:
        """Name of the dialect."""
        return self._dialect.name

    def version(self) -> bytes:
        """Return the announcement at the start of a stream (empty in dialect 2006)."""
        return write_packet(Version(self._dialect.version), self.dialect)

    def define(self, sample: SampleType) -> bytes:
        """Return the SAMPLE_DEF of a type. Indices start at 0x40; a defined type keeps its index.

        Parameters
        ----------
        sample : the name and the type.
        """
        index = self._samples.setdefault(_key(sample), FIRST_INDEX + len(self._samples))
        packet = write_packet(Definition("sample", index, sample.name, sample.type), self.dialect)
        return packet + write_packet(Binding(index, 0), self.dialect) if self._type_defs else packet

    def ref(self, sample: SampleType) -> bytes:
        """Return the SAMPLE_REF of a type, which allows values to refer to the type.

        Parameters
        ----------
        sample : the name and the type.

        Raises
        ------
        LabCommError : if the dialect has no references.
        """
        if not self._dialect.references:
            raise LabCommError(f"Expected a dialect with references to samples, got {self.dialect}.")
        index = self._refs.setdefault(_key(sample), FIRST_INDEX + len(self._refs))
        return write_packet(Definition("ref", index, sample.name, sample.type), self.dialect)

    def ref_index(self, sample: SampleType) -> int:
        """Return the value that refers to a type: the index of its SAMPLE_REF, or 0 if it has none.

        Parameters
        ----------
        sample : the name and the type.
        """
        return self._refs.get(_key(sample), 0)

    def data(self, sample: SampleType, value: Any) -> bytes:
        """Return the packet of a value.

        Parameters
        ----------
        sample : a type already passed to `define`.
        value : a value as in `Sample`; NumPy arrays, and sample types as references, are also accepted.

        Raises
        ------
        LabCommError : if the type is undefined, or the value does not match it; `path` locates the fault.
        """
        last, write = self._last
        if last is not sample:
            if sample not in self._writers:
                self._writers[sample] = self._writer(sample)
            write = self._writers[sample]
            self._last = sample, write
        try:
            return write(value)
        except Misfit as error:
            raise _misfit(sample.name, error) from None

    def _writer(self, sample: SampleType) -> Callable[[Any], bytes]:
        index = self._samples.get(_key(sample))
        if index is None:
            raise LabCommError(f"Expected a defined sample type, got {sample.name!r}. Call define first.")
        return _packets(self._dialect, index, sample.type, writer(sample.type, self._wire))


def write_packet(event: Event, dialect: str, length: int | None = None) -> bytes:
    """Return the bytes of the packet for one event."""
    kind = dialect_named(dialect)
    number = kind.number
    if isinstance(event, Version):
        text = kind.text(event.text.encode())
        return kind.packet(VERSION, text, length) if kind.lengths else text if kind.version else b""
    if isinstance(event, Definition) and (event.kind == "sample" or kind.lengths):
        return kind.packet(_DEFINES[event.kind], _definition(event, kind), length)
    if isinstance(event, Sample):
        wire = Wire(kind, True, lambda sample: 0)
        try:
            return kind.packet(event.index, writer(event.type, wire)(event.value), length)
        except Misfit as error:
            raise _misfit(event.name, error) from None
    if not kind.lengths:
        raise LabCommError(f"Expected a packet of dialect {dialect}, got {type(event).__name__}.")
    if isinstance(event, Binding):
        return kind.packet(TYPE_BINDING, number(event.sample) + number(event.type), length)
    if isinstance(event, Pragma):
        return kind.packet(PRAGMA, kind.text(event.kind.encode("utf-8", "surrogateescape")) + event.body, length)
    if isinstance(event, Other):
        return kind.packet(event.tag, event.body, length)
    if isinstance(event, Unknown):
        return kind.packet(event.index, event.body, length)
    raise LabCommError(f"Expected an event of dialect {dialect}, got {event!r}.")


def _definition(event: Definition, dialect: Dialect) -> bytes:
    if isinstance(event.type, TypeRef) and event.kind != "type":
        raise LabCommError(f"Expected a flat type for the sample {event.name!r}, got a type index.")
    signature = event.type.signature(dialect.name)
    body = dialect.number(event.index) + dialect.label(event.name, event.notes)
    return body + (dialect.text(signature) if dialect.lengths else signature)


def _packets(dialect: Dialect, index: int, node: Type, write: Writer) -> Callable[[Any], bytes]:
    """Return the packet writer of a type; the header of a fixed-size packet is computed only once."""
    if node.fixed_size is None and dialect.lengths:
        return lambda value: dialect.packet(index, write(value))
    head = dialect.number(index) + (dialect.number(node.fixed_size or 0) if dialect.lengths else b"")
    return lambda value: head + write(value)


def _key(sample: SampleType) -> SampleType:
    """Return the identity of a type: name and signature, without notes."""
    return sample if not sample.notes else SampleType(sample.name, sample.type)


def _misfit(name: str, error: Misfit) -> LabCommError:
    path = name + "".join(reversed(error.path))
    return LabCommError(f"{path}: {error.text}.", path=path)
