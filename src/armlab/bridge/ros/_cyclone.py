"""What is used of cyclonedds, in one place: it is an extra."""

from __future__ import annotations

from typing import Any

from armlab.errors import MissingExtra

try:
    from cyclonedds._clayer import ddspy_write
    from cyclonedds.core import DDSException, Listener, Policy, Qos
    from cyclonedds.domain import Domain, DomainParticipant
    from cyclonedds.idl import make_idl_struct, types
    from cyclonedds.pub import DataWriter
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic
except ImportError:
    raise MissingExtra(
        "Expected cyclonedds to speak with ROS 2 over DDS, got none. Install it: pip install 'armlab[ros]'."
    ) from None

_write: Any = ddspy_write


def write_cdr(writer: DataWriter[Any], data: bytes) -> bool:
    """Send the bytes of a message; False when there is no room.

    `DataWriter.write` ends in this call. What it does before, for objects, would be a third of the time of a message.

    Parameters
    ----------
    writer : of the message. data : CDR with its 4 bytes, filled up to a multiple of 4.
    """
    return _write(writer._ref, data) >= 0


__all__ = [
    "DDSException",
    "DataReader",
    "DataWriter",
    "Domain",
    "DomainParticipant",
    "Listener",
    "Policy",
    "Qos",
    "Topic",
    "make_idl_struct",
    "types",
    "write_cdr",
]
