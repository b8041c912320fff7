"""Zenoh alone: `path_zenoh.py read PORT COUNT KEYS` or `path_zenoh.py write PORT KEYS`; see `Key` for the keys.

The writer is a router and sends prepared bytes in which only the stamps change; the reader is a peer, like a node.
"""

from __future__ import annotations

import json
import struct
import sys
from functools import partial
from typing import Any, NamedTuple

import zenoh
from path_ends import Lines, paced

ORIGIN = struct.Struct("<qqB16s")


class Key(NamedTuple):
    """Key, kind ("J" or "W"), offset and format of the stamp in the bytes, and the bytes to send; passed as JSON.

    The format is CDR with int32 s and uint32 ns, or int64 ns. The bytes are in hexadecimal.
    """

    name: str
    kind: str
    at: int
    cdr: bool
    data: str

    def stamp(self, data: bytes) -> int:
        """Return the stamp [ns] in a message."""
        if not self.cdr:
            return struct.unpack_from("<q", data, self.at)[0]
        sec, nanosec = struct.unpack_from("<iI", data, self.at)
        return sec * 10**9 + nanosec

    def message(self, stamp_ns: int) -> bytes:
        """Return a message with a stamp."""
        data = bytearray.fromhex(self.data)
        if self.cdr:
            struct.pack_into("<iI", data, self.at, *divmod(stamp_ns, 10**9))
        else:
            struct.pack_into("<q", data, self.at, stamp_ns)
        return bytes(data)


def main() -> None:
    role, port, *words = sys.argv[1:]
    keys = [Key(*json.loads(word)) for word in words[role == "read" :]]
    place = f"tcp/127.0.0.1:{port}"
    values: dict[str, Any] = {"mode": "peer", "connect/endpoints": [place], "listen/endpoints": ["tcp/127.0.0.1:0"]}
    if role == "write":
        values = {"mode": "router", "listen/endpoints": [place]}
    config = zenoh.Config()
    for name, value in {**values, "scouting/multicast/enabled": False}.items():
        config.insert_json5(name, json.dumps(value))
    with zenoh.open(config) as session:
        if role == "read":
            lines = Lines(int(words[0]))
            readers = [session.declare_subscriber(key.name, partial(_take, lines, key)) for key in keys]
            lines.wait()
            del readers
        else:
            _write(session, keys)


def _take(lines: Lines, key: Key, sample: Any) -> None:
    lines.add(key.kind, key.stamp(sample.payload.to_bytes()))


def _write(session: Any, keys: list[Key]) -> None:
    publishers = [session.declare_publisher(key.name, express=True) for key in keys]
    count = [0]

    def send(stamp_ns: int) -> None:
        count[0] += 1
        for publisher, key in zip(publishers, keys, strict=True):
            attachment = ORIGIN.pack(count[0], stamp_ns, 16, b"n" * 16) if key.cdr else None
            publisher.put(key.message(stamp_ns), attachment=attachment)

    paced(send)


if __name__ == "__main__":
    main()
