"""LabComm on the wire: self-describing streams of samples, all dialects since 2006, and their `.lc` language.

A stream is VERSION, definitions of sample types, and values of them. Trees of `types` describe a value; `Encoder`
writes, `Decoder` reads in pieces of any size, bounded by `Limits`; `parse_lc` reads the types of a program. No sockets,
no files.
"""

from armlab.wire.labcomm.decoder import Decoder
from armlab.wire.labcomm.encoder import Encoder
from armlab.wire.labcomm.idl import parse_lc, to_lc
from armlab.wire.labcomm.types import Sample
from armlab.wire.labcomm.values import Limits

__all__ = ["Decoder", "Encoder", "Limits", "Sample", "parse_lc", "to_lc"]
