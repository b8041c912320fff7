"""What is used of cyclonedds, in one place: it is an extra."""

from __future__ import annotations

from armlab.errors import MissingExtra

try:
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
]
