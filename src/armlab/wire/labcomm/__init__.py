"""LabComm codec for self-describing streams of samples in all dialects since 2006, and for the `.lc` language.

A stream consists of VERSION, definitions of sample types, and values of these types. Trees of `types` describe values.
`Encoder` writes a stream, `Decoder` reads chunks of any size within `Limits`, and `parse_lc` reads type declarations.
The codec uses no sockets or files.
"""

from armlab.wire.labcomm.decoder import Decoder
from armlab.wire.labcomm.encoder import Encoder
from armlab.wire.labcomm.idl import parse_lc, to_lc
from armlab.wire.labcomm.types import Sample
from armlab.wire.labcomm.values import Limits

__all__ = ["Decoder", "Encoder", "Limits", "Sample", "parse_lc", "to_lc"]
