"""`DdsServer`: ROS 2 server over DDS for rows and commands; requires no ROS installation."""

from __future__ import annotations

import contextlib
import ctypes
import ipaddress
import logging
import os
import socket
import threading
from collections.abc import Callable, Collection, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype

from armlab.bridge.servers.messages import Listening
from armlab.bridge.servers.ros.actions import TRAJECTORY
from armlab.bridge.servers.ros.rtps import ServiceServers
from armlab.bridge.servers.ros.server import RosServer
from armlab.bridge.servers.ros.topics import RosTopic, domain_number, later, store, type_name
from armlab.errors import LinkError, MissingExtra

try:
    from cyclonedds._clayer import ddspy_write
    from cyclonedds.core import DDSException, Listener, Policy, Qos
    from cyclonedds.domain import Domain, DomainParticipant
    from cyclonedds.idl import make_idl_struct, types
    from cyclonedds.pub import DataWriter
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic as DdsTopic
except ImportError:
    raise MissingExtra(
        "Expected the package cyclonedds for ROS 2 over DDS, but it is not installed. Install it: pip install "
        "'armlab[ros]'."
    ) from None

_write: Any = ddspy_write
_sertype: Any = DdsTopic._dll_handle.dds_get_entity_sertype
_sertype.argtypes = [ctypes.c_int32, ctypes.c_void_p]


def write_cdr(writer: DataWriter[Any], data: bytes) -> bool:
    """Write serialised bytes with the C function behind `DataWriter.write`; return False if the writer is full."""
    return _write(writer._ref, data) >= 0


_PARTICIPANTS = 32  # number of participants to search for on this computer, as in ROS 2
_LOOPBACK = b"lo"


def configuration(host: str) -> str:
    """Return the Cyclone DDS settings as XML: network interface and discovery (multicast, except on loopback)."""
    if _is_local(host):
        # Announcements to each port of 127.0.0.1 reach nodes with multicast discovery; pruning would miss late nodes.
        found = (
            f"<Peers><Peer address='127.0.0.1'/></Peers><MaxAutoParticipantIndex>{_PARTICIPANTS}"
            "</MaxAutoParticipantIndex><SPDPInterval>2 s</SPDPInterval>"
            "<InitialLocatorPruneDelay>inf</InitialLocatorPruneDelay>"
        )
        interface, multicast = "<NetworkInterface address='127.0.0.1' multicast='false'/>", "false"
    else:
        found, interface, multicast = "", f"<NetworkInterface address='{host}'/>", "spdp"
    return (
        f"<CycloneDDS><Domain Id='any'><General><Interfaces>{interface}</Interfaces><AllowMulticast>{multicast}"
        f"</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>{found}</Discovery></Domain>"
        "</CycloneDDS>"
    )


@contextlib.contextmanager
def joined(domain: int, host: str) -> Iterator[DomainParticipant]:
    """Join a domain for the duration of the block."""
    try:
        settings = Domain(domain, configuration(host))
        participant = DomainParticipant(domain, Qos(Policy.Userdata(b"enclave=/;")))  # else ROS 2 finds no nodes
    except DDSException as error:
        raise LinkError(
            f"Expected to join DDS domain {domain} on {host}, got {error} Use the address of one active network "
            "interface."
        ) from None
    if _is_local(host):
        tie_to_loopback()
    try:
        yield participant
    finally:
        del participant, settings


def tie_to_loopback() -> int:
    """Restrict sockets bound to all addresses (by Cyclone DDS) to this computer; return the number of sockets."""
    count = 0
    for entry in Path("/proc/self/fd").iterdir():
        if not entry.is_socket():
            continue
        with socket.socket(fileno=os.dup(int(entry.name))) as one:
            if one.family == socket.AF_INET and one.getsockname()[0] == "0.0.0.0":
                _tie(one)
                count += 1
    return count


def _tie(one: socket.socket) -> None:
    try:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, _LOOPBACK)
    except OSError as error:
        raise LinkError(
            "Expected DDS to be restricted to this computer, but the operating system "
            f"reported: {error.strerror}. This restriction requires Linux 5.7 or newer; "
            "on other systems, use rosbridge or Zenoh."
        ) from error


def _is_local(host: str) -> bool:
    return ipaddress.ip_address(host).is_loopback


_BASE: dict[str, Any] = {
    "bool": bool,
    "byte": types.uint8,
    "char": types.uint8,
    "string": str,
    **{
        name: getattr(types, name)
        for name in ("int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64")
    },
    **{name: getattr(types, name) for name in ("float32", "float64")},
}


_OPERATIONS = 20  # pointers copied from struct ddsi_sertype_ops
_DESCRIBING = range(8, 11)  # indices of type_id, type_map, type_info
_copies: dict[int, Any] = {}


def untyped_topic(participant: DomainParticipant, name: str, type: Any) -> DdsTopic[Any]:
    """Return a topic whose type is matched by name instead of by XTypes description.

    Cyclone DDS rejects the type descriptions of Fast DDS 3 (Kilted), whose sequence elements have no flags.
    """
    topic, c_type = DdsTopic(participant, name, type), ctypes.POINTER(ctypes.c_void_p)()
    if _sertype(topic._ref, ctypes.byref(c_type)) < 0:
        raise LinkError(f"Expected a type for the DDS topic {name}, got none.")
    known = c_type[0] or 0
    if known not in _copies:
        copied = (ctypes.c_void_p * _OPERATIONS).from_buffer_copy(ctypes.string_at(known, 8 * _OPERATIONS))
        for k in _DESCRIBING:
            copied[k] = None
        _copies[known] = _copies[ctypes.addressof(copied)] = copied
    c_type[0] = ctypes.addressof(_copies[known])
    return topic


def topic_name(name: str) -> str:
    return f"rt{name}"


@cache
def struct(name: str) -> Any:
    """Return a message type as a cyclonedds dataclass with its own codec."""
    return _made(name, is_dataclass=True)


@cache
def carrier(name: str) -> Any:
    """Return a topic type whose attribute `cdr` contains the serialised message."""
    made = _made(name, is_dataclass=False)
    made.__init__, made.serialize = _hold, _held
    made.deserialize = made.deserialize_key = classmethod(_taken)
    return made


def _made(name: str, is_dataclass: bool) -> Any:
    known = later() if name.startswith("rmw_dds_common/") else store()
    members = {member: _member(*about) for member, about in known.fielddefs[name][1]}
    return make_idl_struct(f"{name.rpartition('/')[2]}_", type_name(name), members, dataclassify=is_dataclass)


def _member(kind: Nodetype, about: Any) -> Any:
    if kind == Nodetype.BASE:
        return types.bounded_str[about[1]] if about[1] else _BASE[about[0]]
    if kind == Nodetype.NAME:
        return struct(about)
    if kind == Nodetype.ARRAY:
        return types.array[_member(*about[0]), about[1]]
    return types.sequence[_member(*about[0]), about[1]] if about[1] else types.sequence[_member(*about[0])]


def _hold(self: Any, cdr: bytes) -> None:
    self.cdr = cdr


def _held(self: Any, *_: Any, **__: Any) -> bytes:
    return self.cdr


def _taken(cls: Any, data: bytes, *_: Any, **__: Any) -> Any:
    return cls(bytes(data))


_BLOCKED = 1_000_000  # ns that a write may block; writers that keep only the last message never block
_AT_ONCE = 16  # messages per read
_PREFIX = 24  # leading hexadecimal digits of a GUID, shared by all endpoints of a participant
_XCDR1 = Policy.DataRepresentation(use_cdrv0_representation=True)  # the only representation in ROS 2
_STATE = Qos(
    Policy.Reliability.Reliable(_BLOCKED), Policy.Durability.Volatile, Policy.History.KeepLast(10), _XCDR1
)  # with KeepAll, a stopped reader would block every write
_COMMAND = Qos(Policy.Reliability.BestEffort, Policy.Durability.Volatile, Policy.History.KeepLast(1), _XCDR1)
_LATCHED = Qos(
    Policy.Reliability.Reliable(_BLOCKED), Policy.Durability.TransientLocal, Policy.History.KeepLast(1), _XCDR1
)
_logger = logging.getLogger("armlab.bridge")


def _described(quality: Qos, type_: str) -> Qos:
    """Return the QoS of an endpoint with its type hash, which nodes have published since Iron."""
    return Qos(Policy.Userdata(f"typehash={store().hash_rihs01(type_)};".encode()), base=quality)


class Graph:
    """Publishes the nodes and their endpoints for `ros2 node`.

    A Gid has 24 bytes up to Humble and 16 bytes since Iron. The size follows the newest reader: readers from Iron or
    later announce a type hash.
    """

    _TOPIC, _TYPE = "ros_discovery_info", "rmw_dds_common/msg/ParticipantEntitiesInfo"

    def __init__(self, participant: DomainParticipant, nodes: Mapping[str, list[list[bytes]]]) -> None:
        self._participant, self._nodes = participant.guid.bytes, dict(nodes)
        self._size = 0
        self._lock = threading.Lock()
        listener = Listener(on_publication_matched=self._matched)
        topic = untyped_topic(participant, self._TOPIC, carrier(self._TYPE))
        self._writer: DataWriter[Any] | None = DataWriter(participant, topic, _LATCHED, listener)

    def close(self) -> None:
        self._writer = None

    def _matched(self, writer: DataWriter[Any], status: Any) -> None:
        if status.current_count_change <= 0:
            return
        about = writer.get_matched_subscription_data(_handle(status.last_subscription_handle))
        policies = () if about is None else about.qos
        is_hashed = any(isinstance(one, Policy.Userdata) and b"typehash=" in one.data for one in policies)
        size = 16 if is_hashed else 24
        with self._lock:
            if size != self._size:
                self._size = size
                write_cdr(writer, self.message(size))

    def message(self, size: int) -> bytes:
        """Return the message that lists the nodes and their endpoints, with Gids of `size` bytes."""
        known = later() if size == 16 else store()
        types: Mapping[str, Any] = known.types

        def gid(guid: bytes) -> Any:
            return types["rmw_dds_common/msg/Gid"](np.frombuffer(guid.ljust(size, b"\0"), np.uint8))

        nodes = [
            types["rmw_dds_common/msg/NodeEntitiesInfo"]("/", name, *([*map(gid, some)] for some in ends))
            for name, ends in self._nodes.items()
        ]
        cdr = bytes(known.serialize_cdr(types[self._TYPE](gid(self._participant), nodes), self._TYPE))
        return cdr + bytes(-len(cdr) % 4)


class Writers:
    """Writers of all published topics; `wanted` lists the topics with readers."""

    def __init__(
        self, participant: DomainParticipant, published: Mapping[str, RosTopic], latched: Collection[str] = ()
    ) -> None:
        self.wanted: frozenset[str] = frozenset()
        self.counts: dict[str, tuple[int, int]] = {}
        self._lock = threading.Lock()
        self._writers: dict[str, DataWriter[Any]] = {}
        self._latched = frozenset(latched)
        for name, topic in published.items():
            listener = Listener(on_publication_matched=lambda _, status, name=name: self._matched(name, status))
            made = untyped_topic(participant, topic_name(name), carrier(topic.type))
            quality = _LATCHED if name in latched else _STATE
            self._writers[name] = DataWriter(participant, made, _described(quality, topic.type), listener)

    def write(self, topic: RosTopic, cdr: bytes) -> None:
        written, full = self.counts.get(topic.name, (0, 0))
        went = write_cdr(self._writers[topic.name], cdr + bytes(-len(cdr) % 4))
        if topic.name not in self._latched:
            self.counts[topic.name] = (written + 1, full) if went else (written, full + 1)

    def guids(self) -> list[tuple[str, bytes]]:
        """Return each topic with the GUID of its writer."""
        return [(name, writer.guid.bytes) for name, writer in self._writers.items()]

    def close(self) -> None:
        """Delete all writers, which ends their callbacks."""
        self._writers.clear()

    def _matched(self, name: str, status: Any) -> None:
        with self._lock:
            self.wanted = self.wanted | {name} if status.current_count else self.wanted - {name}


class Readers:
    """Readers of all command topics; callbacks run in DDS threads."""

    def __init__(
        self,
        participant: DomainParticipant,
        types: Mapping[str, str],
        take: Callable[[str, bytes, str], None],
        left: Callable[[str], None],
    ) -> None:
        self._take, self._left = take, left
        self._clients: dict[int, str] = {}
        self._readers: list[DataReader[Any]] = []
        self.guids: list[tuple[str, bytes]] = []
        self._lock = threading.Lock()  # keeps messages in order across the two reading threads
        for name, type_ in types.items():
            listener = Listener(
                on_data_available=lambda reader, name=name: self._guarded(self._read, reader, name),
                on_subscription_matched=lambda reader, status: self._guarded(self._matched, reader, status),
            )
            made = untyped_topic(participant, topic_name(name), carrier(type_))
            reader = DataReader(
                participant, made, _described(_STATE if type_ == TRAJECTORY else _COMMAND, type_), listener
            )
            self._readers.append(reader)
            self.guids.append((name, reader.guid.bytes))
            self._guarded(self._begin, reader, name)

    def close(self) -> None:
        """Delete all readers; their callbacks must end before Python exits."""
        self._readers.clear()

    def _guarded(self, call: Callable[..., None], reader: DataReader[Any] | None, *arguments: Any) -> None:
        """Run a callback and log its errors, which would otherwise surface in C code."""
        try:
            with self._lock:
                if reader in self._readers:  # callbacks before registration are ignored; `_begin` catches up
                    call(reader, *arguments)
        except Exception:
            _logger.exception("ros2")

    def _begin(self, reader: DataReader[Any], name: str) -> None:
        """Handle the writers and messages that existed before the reader."""
        for handle in reader.get_matched_publications():
            self._client(reader, _handle(handle))
        self._read(reader, name)

    def _read(self, reader: DataReader[Any], name: str) -> None:
        known = set(self._clients)
        while samples := reader.take(_AT_ONCE):
            for sample in samples:
                if sample.sample_info.valid_data:  # otherwise a writer has disconnected
                    self._take(name, sample.cdr, self._client(reader, _handle(sample.sample_info.publication_handle)))
        if new := set(self._clients) - known:  # DDS does not report the departure of a writer that was not yet known
            for handle in new.difference(map(_handle, reader.get_matched_publications())):
                self._gone(handle)

    def _matched(self, reader: DataReader[Any], status: Any) -> None:
        handle = _handle(status.last_publication_handle)
        if status.current_count_change > 0:
            self._client(reader, handle)
        else:
            self._gone(handle)

    def _gone(self, handle: int) -> None:
        client = self._clients.pop(handle, None)
        if client is not None and client not in list(self._clients.values()):
            self._left(client)

    def _client(self, reader: DataReader[Any], handle: int) -> str:
        """Return the participant of a writer as the client, because a node may use several writers."""
        if handle not in self._clients:
            about = reader.get_matched_publication_data(handle)
            self._clients[handle] = f"{handle % 2**64:016x}" if about is None else about.participant_key.hex[:_PREFIX]
        return self._clients[handle]


def _handle(number: int) -> int:
    """Return a handle as a signed 64-bit integer, because the handles in samples are unsigned."""
    return (int(number) + 2**63) % 2**64 - 2**63


class DdsServer(RosServer):
    """ROS 2 server over DDS at the IPv4 address `host`; if `domain` is None, ROS_DOMAIN_ID is used."""

    def __init__(self, feed: socket.socket, options: Mapping[str, Any]) -> None:
        self._domain, self._host = domain_number(options["domain"]), options["host"]
        self._writers: Writers
        self._servers: ServiceServers
        super().__init__(feed, lambda: dict(self._writers.counts), options.get("tf", False))

    def wanted(self) -> frozenset[str]:
        return self._writers.wanted

    def write(self, topic: RosTopic, cdr: bytes) -> None:
        self._writers.write(topic, cdr)

    def run(self) -> None:
        with joined(self._domain, self._host) as participant:
            writers = self._writers = Writers(participant, self.published, self.latched)
            readers = Readers(participant, self._commands.types | self._goals.topics, self.take, self.left)
            servers = self._servers = ServiceServers(
                self._domain, self._host, self.services, self.request, self.left_service
            )
            ends = readers.guids + servers.readers, writers.guids() + servers.writers

            def owned(node: str) -> list[list[bytes]]:
                return [[guid for name, guid in some if self.node_of(name) == node] for some in ends]

            graph = Graph(participant, {node: owned(node) for node in self.nodes})
            try:
                self.send_latched()
                self._loop.ask(Listening(where=[f"{self._host} (ros2, DDS domain {self._domain})"]))
                self.serve()
            finally:
                servers.close()
                graph.close()
                readers.close()
                writers.close()
