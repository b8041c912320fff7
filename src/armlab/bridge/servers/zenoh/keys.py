"""Names on Zenoh: ``armlab/<lab>/<robot>/<what>``, and what is attached to a command."""

from __future__ import annotations

import struct
from typing import NamedTuple

from armlab.errors import CommandRefused

__all__ = ["COMMANDS", "EVERY", "Attachment", "key", "robot_of"]

EVERY = "*"
"""Stands for every lab or every robot in a key."""

COMMANDS = {"position": "q", "velocity": "qd", "effort": "tau", "motion": "q qd"}
"""Last word of a command's key, and what its numbers are: n of each, "motion" is positions and then velocities."""

_ATTACHED = struct.Struct("<16sqq")


def key(lab: str, robot: str, what: str) -> str:
    """Return a key."""
    return f"armlab/{lab}/{robot}/{what}"


def robot_of(name: str) -> tuple[str, str]:
    """Return lab and robot of a key."""
    _, lab, robot, *_ = name.split("/")
    return lab, robot


class Attachment(NamedTuple):
    """What is attached to a command or a setting: 32 bytes, little-endian."""

    sender: bytes
    seq: int
    stamp_ns: int

    def pack(self) -> bytes:
        """Return the bytes."""
        return _ATTACHED.pack(*self)

    @classmethod
    def read(cls, data: bytes | None) -> Attachment:
        """Return what the bytes say."""
        if data is None or len(data) != _ATTACHED.size:
            got = "none" if data is None else f"{len(data)} bytes"
            raise CommandRefused(
                f"Expected {_ATTACHED.size} bytes attached (16 of the sender's id, int64 number, int64 ns), got {got}."
            )
        return cls(*_ATTACHED.unpack(data))

    @property
    def client(self) -> str:
        """The sender as people read it: all of its id, so that no two are one."""
        return self.sender.hex()
