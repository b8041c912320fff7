"""`DdsServer`: ROS 2 nodes read and command over DDS, without a ROS installation here."""

from __future__ import annotations

import contextlib
import ipaddress
import logging
import os
import socket
import threading
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from rosbags.interfaces import Nodetype

from armlab.bridge.servers.messages import Listening
from armlab.bridge.servers.ros.server import RosServer
from armlab.bridge.servers.ros.topics import RosTopic, domain_number, store, type_name
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
        "Expected cyclonedds to speak with ROS 2 over DDS, got none. Install it: pip install 'armlab[ros]'."
    ) from None

_write: Any = ddspy_write


def write_cdr(writer: DataWriter[Any], data: bytes) -> bool:
    """Send the bytes of a message by what `DataWriter.write` ends in; False when there is no room."""
    return _write(writer._ref, data) >= 0


_PARTICIPANTS = 32  # of this computer that are looked for, as many as ROS 2 does
_LOOPBACK = b"lo"


def configuration(host: str) -> str:
    """Return the settings of Cyclone DDS as XML: where it speaks, and how others are found.

    On this computer the bridge announces itself to each port of 127.0.0.1 every 2 s, so that a node with multicast
    discovery also finds it. Cyclone DDS would drop ports that do not answer for 30 s, and with them every node started
    later. On a network participants are found by multicast.
    """
    if _is_local(host):
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
    """Be a participant of a domain while the block runs."""
    try:
        settings = Domain(domain, configuration(host))
        participant = DomainParticipant(domain)
    except DDSException as error:
        raise LinkError(
            f"Expected to join DDS domain {domain} on {host}, but {error} Give the address of one network interface "
            "that is up."
        ) from None
    if _is_local(host):
        tie_to_loopback()
    try:
        yield participant
    finally:
        del participant, settings


def tie_to_loopback() -> int:
    """Keep what comes from other computers off the sockets of this process, and return of how many.

    Cyclone DDS binds what it receives by to every address, whatever the interface (its `ddsi_udp.c`).
    """
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
            f"Expected to keep DDS to this computer, but the system does not ({error.strerror}). It needs Linux 5.7 "
            "or newer; on others, use rosbridge or Zenoh."
        ) from error


def _is_local(host: str) -> bool:
    return ipaddress.ip_address(host).is_loopback


_BASE: dict[str, Any] = {
    "bool": bool,
    "byte": types.byte,
    "uint8": types.uint8,
    "int32": types.int32,
    "uint32": types.uint32,
    "float64": types.float64,
    "string": str,
}


def topic_name(name: str) -> str:
    return f"rt{name}"


@cache
def struct(name: str) -> Any:
    """Return a message type as a dataclass of cyclonedds, which has a codec of its own."""
    return _made(name, is_dataclass=True)


@cache
def carrier(name: str) -> Any:
    """Return the type for a topic, whose objects hold the bytes of a message as attribute `cdr`."""
    made = _made(name, is_dataclass=False)
    made.__init__, made.serialize = _hold, _held
    made.deserialize = made.deserialize_key = classmethod(_taken)
    return made


def _made(name: str, is_dataclass: bool) -> Any:
    members = {member: _member(*about) for member, about in store().fielddefs[name][1]}
    return make_idl_struct(f"{name.rpartition('/')[2]}_", type_name(name), members, dataclassify=is_dataclass)


def _member(kind: Nodetype, about: Any) -> Any:
    if kind == Nodetype.BASE:
        return _BASE[about[0]]
    if kind == Nodetype.NAME:
        return struct(about)
    if kind == Nodetype.SEQUENCE:
        return types.sequence[_member(*about[0])]
    raise NotImplementedError(f"Expected no fixed array in a message of ours, got {about}.")


def _hold(self: Any, cdr: bytes) -> None:
    self.cdr = cdr


def _held(self: Any, *_: Any, **__: Any) -> bytes:
    return self.cdr


def _taken(cls: Any, data: bytes, *_: Any, **__: Any) -> Any:
    return cls(bytes(data))


_BLOCKED = 1_000_000  # ns that a write may wait, which none does that keeps the last only
_AT_ONCE = 16  # messages of one look
_PREFIX = 24  # hexadecimal digits of a GUID that all endpoints of a participant have
_XCDR1 = Policy.DataRepresentation(use_cdrv0_representation=True)  # all that ROS 2 speaks
_STATE = Qos(
    Policy.Reliability.Reliable(_BLOCKED), Policy.Durability.Volatile, Policy.History.KeepLast(10), _XCDR1
)  # never KeepAll: a reader that stopped would hold every write up
_COMMAND = Qos(Policy.Reliability.BestEffort, Policy.Durability.Volatile, Policy.History.KeepLast(1), _XCDR1)
_logger = logging.getLogger("armlab.bridge")


class Writers:
    """Writes topics that somebody reads."""

    def __init__(self, participant: DomainParticipant, published: Mapping[str, RosTopic]) -> None:
        self.wanted: frozenset[str] = frozenset()
        self.counts: dict[str, tuple[int, int]] = {}
        self._lock = threading.Lock()
        self._writers: dict[str, DataWriter[Any]] = {}
        for name, topic in published.items():
            listener = Listener(on_publication_matched=lambda _, status, name=name: self._matched(name, status))
            made = DdsTopic(participant, topic_name(name), carrier(topic.type))
            self._writers[name] = DataWriter(participant, made, _STATE, listener)

    def write(self, topic: RosTopic, cdr: bytes) -> None:
        written, full = self.counts.get(topic.name, (0, 0))
        went = write_cdr(self._writers[topic.name], cdr + bytes(-len(cdr) % 4))
        self.counts[topic.name] = (written + 1, full) if went else (written, full + 1)

    def close(self) -> None:
        """End all writers: none calls any more."""
        self._writers.clear()

    def _matched(self, name: str, status: Any) -> None:
        with self._lock:
            self.wanted = self.wanted | {name} if status.current_count else self.wanted - {name}


class Readers:
    """Reads topics; calls from threads of DDS."""

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
        self._lock = threading.Lock()  # in the order in which it came, though two threads look
        for name, type_ in types.items():
            listener = Listener(
                on_data_available=lambda reader, name=name: self._guarded(self._read, reader, name),
                on_subscription_matched=lambda reader, status: self._guarded(self._matched, reader, status),
            )
            made = DdsTopic(participant, topic_name(name), carrier(type_))
            reader = DataReader(participant, made, _COMMAND, listener)
            self._readers.append(reader)
            self._guarded(self._begin, reader, name)

    def close(self) -> None:
        """End all readers: none calls any more, which it must not while Python ends."""
        self._readers.clear()

    def _guarded(self, call: Callable[..., None], reader: DataReader[Any] | None, *arguments: Any) -> None:
        """Call; what fails is told and no more, since it would come up in C.

        DDS may call as soon as it has the reader itself, in Python there is none or half of one then: `_begin` follows.
        """
        try:
            with self._lock:
                if reader in self._readers:
                    call(reader, *arguments)
        except Exception:
            _logger.exception("ros2")

    def _begin(self, reader: DataReader[Any], name: str) -> None:
        """Take up what was there before the reader was."""
        for handle in reader.get_matched_publications():
            self._client(reader, _handle(handle))
        self._read(reader, name)

    def _read(self, reader: DataReader[Any], name: str) -> None:
        known = set(self._clients)
        while samples := reader.take(_AT_ONCE):
            for sample in samples:
                if sample.sample_info.valid_data:  # else a writer that has gone
                    self._take(name, sample.cdr, self._client(reader, _handle(sample.sample_info.publication_handle)))
        if new := set(self._clients) - known:  # one that ended before it was known is not told as gone any more
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
        """Return who writes, the participant: with one of its writers it commands, with another it sets a parameter."""
        if handle not in self._clients:
            about = reader.get_matched_publication_data(handle)
            self._clients[handle] = f"{handle % 2**64:016x}" if about is None else about.participant_key.hex[:_PREFIX]
        return self._clients[handle]


def _handle(number: int) -> int:
    """Return a handle as 64 bits with a sign: samples say it without one, conditions and calls with one."""
    return (int(number) + 2**63) % 2**64 - 2**63


class DdsServer(RosServer):
    """Speaks DDS at the IPv4 address `host`, in a domain, that of ROS_DOMAIN_ID when None."""

    def __init__(self, feed: socket.socket, options: Mapping[str, Any]) -> None:
        self._domain, self._host = domain_number(options["domain"]), options["host"]
        self._writers: Writers
        super().__init__(feed, lambda: dict(self._writers.counts))

    def wanted(self) -> frozenset[str]:
        return self._writers.wanted

    def write(self, topic: RosTopic, cdr: bytes) -> None:
        self._writers.write(topic, cdr)

    def run(self) -> None:
        with joined(self._domain, self._host) as participant:
            writers = self._writers = Writers(participant, self._topics.published)
            readers = Readers(participant, self._commands.types, self.take, self.left)
            try:
                self._loop.ask(Listening(where=[f"{self._host} (ros2, DDS domain {self._domain})"]))
                self.serve()
            finally:
                readers.close()
                writers.close()
