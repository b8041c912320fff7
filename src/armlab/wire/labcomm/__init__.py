"""LabComm on the wire: self-describing streams of samples, all dialects since 2006, and their `.lc` language.

A stream is VERSION, definitions of sample types, and values of them. Trees of `types` describe a value; `Encoder`
writes, `Decoder` reads in pieces of any size, bounded by `Limits`; `parse_lc` reads the types of a program. No sockets,
no files.
"""

from armlab.wire.labcomm.decoder import Decoder
from armlab.wire.labcomm.dialects import DIALECTS
from armlab.wire.labcomm.encoder import Encoder, write_packet
from armlab.wire.labcomm.idl import Typedef, parse_lc, to_lc
from armlab.wire.labcomm.signature import parse_signature
from armlab.wire.labcomm.source import Limits
from armlab.wire.labcomm.types import (
    PRIMS,
    VOID,
    Array,
    Binding,
    Definition,
    Event,
    Field,
    Other,
    Pragma,
    Prim,
    Sample,
    SampleType,
    Struct,
    Unknown,
    Version,
)

__all__ = [
    "DIALECTS",
    "PRIMS",
    "VOID",
    "Array",
    "Binding",
    "Decoder",
    "Definition",
    "Encoder",
    "Event",
    "Field",
    "Limits",
    "Other",
    "Pragma",
    "Prim",
    "Sample",
    "SampleType",
    "Struct",
    "Typedef",
    "Unknown",
    "Version",
    "parse_lc",
    "parse_signature",
    "to_lc",
    "write_packet",
]
