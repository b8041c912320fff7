"""How rmw_zenoh writes topics, nodes and messages on Zenoh (ros2/rmw_zenoh, docs/design.md): `Names`, `Writer`.

Data goes under ``<domain>/<topic>/<type>/<hash>``. The graph is liveliness tokens, one for the node and one for each
of its writers and readers. Each message carries 33 bytes: its number, its time, and who wrote it.
"""

from __future__ import annotations

import struct
from typing import Any, Literal, NamedTuple

from armlab.bridge.ros.ros2 import type_name
from armlab.bridge.ros.types import store
from armlab.errors import MissingExtra

__all__ = ["ANY", "Distribution", "Names", "Origin", "Writer"]

ANY = "*"
"""In place of a hash in the key of a reader: writers of every distribution."""

Distribution = Literal["humble", "jazzy", "kilted"]
"""Of ROS 2: Humble knows no hashes of types."""

_RELIABLE, _BEST_EFFORT = "::,10:,:,:,,", "2::,1:,:,:,,"  # volatile; keep the last 10, the last 1
_NO_HASH = "TypeHashNotSupported"
_ID = 16
_ORIGIN = struct.Struct(f"<qqB{_ID}s")


class Names:
    """Keys of one node.

    Parameters
    ----------
    domain : its number. session : id of the Zenoh session, hexadecimal. distribution : of those who read.
    node : its name, in the namespace "/".
    """

    def __init__(self, domain: int, session: str, distribution: Distribution = "jazzy", node: str = "armlab") -> None:
        self._domain, self._node, self._has_hashes = domain, node, distribution != "humble"
        self._graph = f"@ros2_lv/{domain}/{session}"

    def hash(self, type: str) -> str:
        """Return what stands for the definition of a message type.

        Parameters
        ----------
        type : for example "sensor_msgs/msg/JointState".
        """
        return store().hash_rihs01(type) if self._has_hashes else _NO_HASH

    def data(self, topic: str, type: str, hash: str = "") -> str:
        """Return the key of a topic's messages.

        Parameters
        ----------
        topic : full name. type : of its messages. hash : `ANY` for a reader; that of the type by default.
        """
        return f"{self._domain}/{topic.strip('/')}/{type_name(type)}/{hash or self.hash(type)}"

    def node(self) -> str:
        """Return the token of the node, whose number is 0."""
        return f"{self._graph}/0/0/NN/%/%/{self._node}"

    def writers(self) -> str:
        """Return what the tokens of all writers of the domain match."""
        return f"@ros2_lv/{self._domain}/*/*/*/MP/**"

    def writer(self, number: int, topic: str, type: str) -> str:
        """Return the token of a reliable writer that keeps the last ten.

        Parameters
        ----------
        number : of the endpoint in the node, from 1. topic, type : as of `data`.
        """
        return self._endpoint(number, "MP", topic, type, _RELIABLE)

    def reader(self, number: int, topic: str, type: str) -> str:
        """Return the token of a best-effort reader of the last one.

        Parameters
        ----------
        number, topic, type : as of `writer`.
        """
        return self._endpoint(number, "MS", topic, type, _BEST_EFFORT)

    def _endpoint(self, number: int, kind: str, topic: str, type: str, quality: str) -> str:
        about = f"{topic.replace('/', '%')}/{type_name(type)}/{self.hash(type)}/{quality}"
        return f"{self._graph}/0/{number}/{kind}/%/%/{self._node}/{about}"


class Origin(NamedTuple):
    """What is attached to a message: its number from 1, when it was written [ns], and who wrote it (16 bytes)."""

    seq: int
    stamp_ns: int
    writer: bytes

    def pack(self) -> bytes:
        """Return the 33 bytes."""
        return _ORIGIN.pack(self.seq, self.stamp_ns, _ID, self.writer)

    @classmethod
    def read(cls, data: bytes | None) -> Origin | None:
        """Return what the bytes say; None for others, whose message is dropped as rmw_zenoh drops it.

        Parameters
        ----------
        data : of the attachment, None without one.
        """
        if data is None or len(data) != _ORIGIN.size:
            return None
        seq, stamp_ns, size, writer = _ORIGIN.unpack(data)
        return cls(seq, stamp_ns, writer) if size == _ID else None

    @property
    def client(self) -> str:
        """The writer as people read it: all of its id, so that no two are one."""
        return self.writer.hex()


class Writer:
    """Numbers the messages of one writer.

    Parameters
    ----------
    token : its liveliness token, of which its id is the hash.

    Raises
    ------
    MissingExtra : xxhash is not installed; says how to.
    """

    def __init__(self, token: str) -> None:
        self.id = _hashed(token)
        self._seq = 0

    def next(self, stamp_ns: int) -> bytes:
        """Return the attachment of the next message.

        Parameters
        ----------
        stamp_ns : wall clock.
        """
        self._seq += 1
        return _ORIGIN.pack(self._seq, stamp_ns, _ID, self.id)


def _hashed(token: str) -> bytes:
    try:
        import xxhash
    except ImportError:
        raise MissingExtra(
            "Expected xxhash to speak with rmw_zenoh, got none. Install it: pip install 'armlab[net]'."
        ) from None
    value: Any = xxhash.xxh3_128_intdigest(token.encode())
    return value.to_bytes(_ID, "little")
