"""ROS 2 server over DDS in a thread, in its own domain, and participants that act as ROS nodes."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Iterator
from itertools import count
from typing import Any

import pytest

pytest.importorskip("cyclonedds", reason="the extra ros is not installed")

from armlab import robots
from armlab.bridge.inputs.parameters import Parameter
from armlab.bridge.servers.ros.dds import (
    DataReader,
    DataWriter,
    DdsServer,
    DdsTopic,
    DomainParticipant,
    Policy,
    Qos,
    _member,
    _taken,
    carrier,
    make_idl_struct,
    topic_name,
    types,
)
from armlab.bridge.servers.ros.topics import store, type_name

from ..conftest import Served, until
from .conftest import OTHERS

RELIABLE = Qos(Policy.Reliability.Reliable(0), Policy.History.KeepLast(10))


def _domains() -> Iterator[int]:
    start = os.getpid() % 100
    return (1 + (start + k) % 100 for k in count())


_NEXT = _domains()


def free_domain() -> int:
    """Return a domain without participants on this computer."""
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


def _service_type(name: str) -> Any:
    """Return the request or response type of rmw_cyclonedds, with client and number before the fields."""
    header = {"client": types.uint64, "number": types.int64}
    members = {member: _member(*about) for member, about in store().fielddefs[name][1]}
    made: Any = make_idl_struct(
        f"{name.rpartition('/')[2]}_", type_name(name), {**header, **members}, dataclassify=False
    )
    known = carrier(name)
    made.__init__, made.serialize = known.__init__, known.serialize
    made.deserialize = made.deserialize_key = classmethod(_taken)
    return made


class Node:
    def __init__(self, domain: int) -> None:
        self.domain, self.participant = domain, DomainParticipant(domain)
        self.client = self.participant.guid.hex[:24]

    def reader(self, name: str, type_: str) -> DataReader[Any]:
        return DataReader(self.participant, DdsTopic(self.participant, topic_name(name), carrier(type_)), RELIABLE)

    def read_late(self, name: str, type_: str) -> Callable[[], list[Any]]:
        topic = DdsTopic(self.participant, topic_name(name), carrier(type_))
        reader = DataReader(self.participant, topic, Qos(Policy.Durability.TransientLocal, base=RELIABLE))
        return lambda: taken(reader, type_)

    def read(self, name: str, type_: str) -> Callable[[], list[Any]]:
        reader, found = self.reader(name, type_), list[Any]()

        def come() -> list[Any]:
            found.extend(taken(reader, type_))
            return found

        return come

    def writer(self, name: str, type_: str) -> Writer:
        topic = DdsTopic(self.participant, topic_name(name), carrier(type_))
        return Writer(DataWriter(self.participant, topic, RELIABLE), type_)

    def call(self, name: str, type_: str, request: Any) -> Any:
        return self.caller(name, type_)(request)

    def caller(self, name: str, type_: str) -> Callable[[Any], Any]:
        kinds, headers = [f"{type_}_{kind}" for kind in ("Request", "Response")], (os.urandom(16) for _ in count())
        asked, told = map(_service_type, kinds)
        writer = DataWriter(self.participant, DdsTopic(self.participant, f"rq{name}Request", asked), RELIABLE)
        reader = DataReader(self.participant, DdsTopic(self.participant, f"rr{name}Reply", told), RELIABLE)
        until(lambda: writer.get_matched_subscriptions() and reader.get_matched_publications())

        def call(request: Any) -> Any:
            cdr, header = bytes(store().serialize_cdr(request, kinds[0])), next(headers)
            writer.write(asked(cdr[:4] + header + cdr[4:] + bytes(-len(cdr) % 4)))
            found: list[bytes] = []

            def come() -> list[bytes]:
                samples = [one for one in reader.take(10) if one.sample_info.valid_data]
                found.extend(one.cdr for one in samples if one.cdr[4:20] == header)
                return found

            until(come)
            return store().deserialize_cdr(found[0][:4] + found[0][20:], kinds[1])

        return call


class Writer:
    def __init__(self, writer: DataWriter[Any], type_: str) -> None:
        self.writers, self._type = [writer], type_

    def write(self, raw: bytes) -> None:
        self.writers[0].write(carrier(self._type)(raw + bytes(-len(raw) % 4)))

    def leave(self) -> None:
        self.writers.clear()

    def is_matched(self) -> bool:
        return bool(self.writers[0].get_matched_subscriptions())


def taken(reader: DataReader[Any], type_: str) -> list[Any]:
    samples = [sample for sample in reader.take(100) if sample.sample_info.valid_data]
    return [store().deserialize_cdr(sample.cdr, type_) for sample in samples]


class DdsCell(Served):
    def __init__(self, rights: Any = "anyone") -> None:
        gain = Parameter("gain", 0.5, minimum=0.0, maximum=1.0, rights=rights)
        self.domain = free_domain()
        options = {"domain": self.domain, "host": "127.0.0.1", "tf": True}
        arm = robots.load("yumi_left")
        super().__init__("ros2", arm, lambda feed: DdsServer(feed, options), [gain, *OTHERS])
        assert self.where == [f"127.0.0.1 (ros2, DDS domain {self.domain})"]
        self.node = self.join()

    def join(self, name: str = "") -> Node:
        return Node(self.domain)

    def close(self) -> None:
        del self.node
        super().close()
