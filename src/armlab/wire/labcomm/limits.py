"""`Limits`: how much a stream may ask of its reader."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Limits"]


@dataclass(frozen=True, slots=True)
class Limits:
    """Bounds of a decoder; beyond one of them a stream is refused before anything is built.

    Attributes
    ----------
    packet : bytes of a body. values : leaves and containers of a packet, one size, nodes of a definition.
    definitions : per table. nodes : kept per stream.
    empty_rows : product of the sizes before a size of zero. depth : levels of a type, the root is level 1.
    name, version : bytes. dims : of an array. entries : of a name with notes.
    """

    packet: int
    values: int
    definitions: int
    nodes: int
    empty_rows: int = 256
    depth: int = 32
    name: int = 255
    version: int = 64
    dims: int = 16
    entries: int = 64

    @classmethod
    def server(cls) -> Limits:
        """Return the limits for peers on the network: 64 KiB per packet, 16 384 values, 1024 definitions."""
        return cls(packet=65_536, values=16_384, definitions=1024, nodes=65_536)

    @classmethod
    def file(cls) -> Limits:
        """Return the limits for files: 16 MiB per packet, 2 097 152 values, 4096 definitions."""
        return cls(packet=16_777_216, values=2_097_152, definitions=4096, nodes=1_048_576)
