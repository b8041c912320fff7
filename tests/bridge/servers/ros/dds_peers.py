"""What the tests over DDS share: a domain of their own, and participants in this process."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from itertools import count
from typing import Any

import pytest

pytest.importorskip("cyclonedds", reason="the extra ros is not installed")

from armlab.bridge.servers.ros.dds import (
    DataReader,
    DataWriter,
    DdsTopic,
    DomainParticipant,
    Policy,
    Qos,
    carrier,
    topic_name,
)
from armlab.bridge.servers.ros.topics import store

RELIABLE = Qos(Policy.Reliability.Reliable(0), Policy.History.KeepLast(10))


def _domains() -> Iterator[int]:
    """Domains below the ports that the system hands out, another one for each process that tests."""
    start = os.getpid() % 100
    return (1 + (start + k) % 100 for k in count())


_NEXT = _domains()


def free_domain() -> int:
    """Return a domain in which no participant of this computer is: its first ports are free."""
    for domain in _NEXT:
        ports = [7400 + 250 * domain + 10 + 2 * index for index in range(4)]
        if all(map(_is_free, ports)):
            return domain
    raise AssertionError


def _is_free(port: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        try:
            one.bind(("0.0.0.0", port))
        except OSError:
            return False
    return True


class Node:
    """A participant in this process, beside that of the server."""

    def __init__(self, domain: int) -> None:
        self.domain, self.participant = domain, DomainParticipant(domain)

    def reader(self, name: str, type_: str) -> DataReader[Any]:
        return DataReader(self.participant, DdsTopic(self.participant, topic_name(name), carrier(type_)), RELIABLE)

    def writer(self, name: str, type_: str) -> DataWriter[Any]:
        return DataWriter(self.participant, DdsTopic(self.participant, topic_name(name), carrier(type_)), RELIABLE)


def taken(reader: DataReader[Any], type_: str) -> list[Any]:
    """Messages of `store` that have come."""
    samples = [sample for sample in reader.take(100) if sample.sample_info.valid_data]
    return [store().deserialize_cdr(sample.cdr, type_) for sample in samples]


def write(writer: DataWriter[Any], type_: str, *fields: Any) -> None:
    """Send a message of `store`."""
    message = store().types[type_](*fields)
    writer.write(carrier(type_)(bytes(store().serialize_cdr(message, type_))))


def numbers(*values: float) -> tuple[Any, Any]:
    """Fields of a Float64MultiArray."""
    import numpy as np

    return store().types["std_msgs/msg/MultiArrayLayout"]([], 0), np.array(values)
