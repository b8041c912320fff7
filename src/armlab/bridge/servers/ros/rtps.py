"""`ServiceServers`: ROS 2 service servers for Fast DDS and Cyclone DDS nodes, with a minimal RTPS implementation.

rmw_fastrtps links a response to its request through the inline QoS of both (DDS-RPC, related_sample_identity), which
cyclonedds can neither read nor write. rmw_cyclonedds links the two through 16 bytes before the fields, so the bytes no
longer match the type that cyclonedds checks. The RTPS participant of this module has only request readers and response
writers. Sources: OMG DDSI-RTPS 2.3, chapters 8 and 9; DDS-RPC 1.0, section 7.6.
"""

from __future__ import annotations

import contextlib
import ipaddress
import itertools
import logging
import os
import select
import socket
import struct
import threading
import time
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial

from armlab.bridge.servers.ros.services import Service
from armlab.bridge.servers.ros.topics import type_name

_DATA, _FRAGMENT, _HEARTBEAT, _ACKNACK, _NACK_FRAGMENT, _GAP = 0x15, 0x16, 0x07, 0x06, 0x12, 0x08
_SOURCE, _DESTINATION = 0x0C, 0x0E
_SPDP, _PUBLICATIONS, _SUBSCRIPTIONS = b"\0\1\0\xc2", b"\0\0\3\xc2", b"\0\0\4\xc2"
_PARTICIPANT, _ANY, _ENDPOINTS = b"\0\0\1\xc1", bytes(4), 0x3F
_RESPONSES, _REQUESTS = b"\x03", b"\x04"  # entity kinds of a keyless writer and a keyless reader
_VERSION, _NO_VENDOR, _CYCLONE = b"\2\3", b"\0\0", b"\x01\x10"
_HEADER = b"RTPS" + _VERSION + _NO_VENDOR
_CLIENT = slice(4, 20)  # client and request number, which rmw_cyclonedds writes before the fields
_TOPIC, _ENDPOINT, _KEY, _STATUS = 0x05, 0x5A, 0x70, 0x71  # parameter ids
_PL_CDR = b"\0\3\0\0"
_RELATED = 0x0083, 0x800F  # parameter ids of the related sample identity: standard, Fast DDS
_ANNOUNCE, _TICK, _LEASE = 2.0, 0.25, 20  # s
_PARTICIPANTS = 32  # number of participants to search for on this computer, as with Cyclone DDS
_KEPT = 64  # number of responses that a writer keeps for retransmission
_WINDOW = 256
_LARGEST = 2**19  # maximum size of a request in bytes
_FRAGMENTS = 4096  # maximum number of fragments of a request
_PARTIAL = 4  # maximum number of incomplete requests kept per client
_BUFFER = 2**21  # receive buffer in bytes: all fragments of a large request arrive at once
_MOST = 1024  # maximum number of known remote endpoints; more are treated as a flood
_logger = logging.getLogger("armlab.bridge")


def _sn(number: int) -> bytes:
    return struct.pack("<iI", number >> 32, number & 0xFFFFFFFF)


def _parameter(pid: int, value: bytes) -> bytes:
    value += bytes(-len(value) % 4)
    return struct.pack("<HH", pid, len(value)) + value


def _text(value: str) -> bytes:
    data = value.encode() + b"\0"
    return struct.pack("<I", len(data)) + data


def _set(base: int, members: Collection[int]) -> bytes:
    """Encode a number set: the bit count, followed by one bit per number, starting at the base."""
    size = max(members, default=base - 1) - base + 1
    bits = [0] * ((size + 31) // 32)
    for k in members:
        bits[(k - base) // 32] |= 1 << 31 - (k - base) % 32
    return struct.pack(f"<I{len(bits)}I", size, *bits)


def _members(base: int, data: bytes, place: int, order: str) -> list[int]:
    """Decode a sequence number set."""
    size = min(struct.unpack_from(f"{order}I", data, place)[0], _WINDOW)
    words = struct.unpack_from(f"{order}{(size + 31) // 32}I", data, place + 4)
    return [base + k for k in range(size) if words[k // 32] >> 31 - k % 32 & 1]


def _message(kind: int, flags: int, body: bytes) -> bytes:
    return struct.pack("<BBH", kind, flags | 1, len(body)) + body


def _data(writer: bytes, number: int, payload: bytes, inline: bytes = b"") -> bytes:
    """Return a DATA message addressed to any reader, because the known reader may be replaced before the message
    arrives."""
    head = struct.pack("<HH", 0, 16) + _ANY + writer + _sn(number)
    if inline:
        inline += _parameter(1, b"")
    payload += bytes(-len(payload) % 4)
    return _message(_DATA, 4 | (2 if inline else 0), head + inline + payload)


def _parameters(data: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    place = 0
    while place + 4 <= len(data):
        pid, size = struct.unpack_from(f"{order}HH", data, place)
        if pid == 1:
            return
        yield pid, data[place + 4 : place + 4 + size]
        place += 4 + size


def _listed(payload: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield the parameters of a payload."""
    return _parameters(payload[4:], "<" if payload[1:2] in (b"\1", b"\3") else ">")


def _inline(body: bytes, place: int, flags: int, order: str) -> tuple[dict[int, bytes], int]:
    """Return the parameters of the inline QoS (if any) and the offset of the payload."""
    found: dict[int, bytes] = {}
    if flags & 2:
        for pid, value in _parameters(body[place:], order):
            found[pid] = value
            place += 4 + len(value)
        place += 4
    return found, place


@dataclass
class _Writer:
    """Reliable writer; a reader without history skips all messages announced by the first heartbeat sent to it."""

    id: bytes
    messages: dict[int, tuple[bytes, bytes]] = field(default_factory=dict)  # payload and inline QoS by number
    last: int = 0
    owners: dict[int, bytes] = field(default_factory=dict)  # requesting participants, whose readers may appear later
    acknowledged: dict[bytes, int] = field(default_factory=dict)  # last number acknowledged by each reader
    heard: set[bytes] = field(default_factory=set)  # readers that answered a heartbeat; others get empty heartbeats

    def forget(self, reader: bytes) -> None:
        self.acknowledged.pop(reader, None)
        self.heard.discard(reader)

    def add(self, payload: bytes, inline: bytes = b"") -> int:
        self.last += 1
        self.messages[self.last] = payload, inline
        return self.last


@dataclass
class _Reader:
    """Reliable reader of one remote writer; keeps messages received out of order."""

    next: int = 1
    early: dict[int, bytes] = field(default_factory=dict)
    partial: dict[int, tuple[bytearray, set[int]]] = field(default_factory=dict)  # data and missing fragments

    def join(self, number: int, total: int, size: int, first: int, part: bytes) -> bytes:
        """Add fragments; return the message once it is complete, otherwise b"". `first` is the number of the first
        fragment, counted from 1."""
        if not self.next <= number < self.next + _WINDOW or not 0 < total <= min(_LARGEST, _FRAGMENTS * size):
            return b""
        while len(self.partial) >= _PARTIAL and number not in self.partial:
            del self.partial[next(iter(self.partial))]
        data, missing = self.partial.setdefault(number, (bytearray(total), set(range(1, 1 - (-total // size)))))
        start, part = (first - 1) * size, part[: max(0, len(data) - (first - 1) * size)]
        data[start : start + len(part)] = part
        missing.difference_update(range(first, first + -(-len(part) // size)))
        if missing:
            return b""
        del self.partial[number]
        return bytes(data)

    def put(self, number: int, payload: bytes) -> None:
        """Keep a message until `take` reaches its number; an empty message marks a gap."""
        if self.next <= number < self.next + _WINDOW:
            self.early[number] = payload

    def skip(self, number: int) -> None:
        """Skip to a sequence number, because no messages with smaller numbers will arrive."""
        if number > self.next + _WINDOW:
            self.next = number
            self.early.clear()
            self.partial.clear()
        for k in range(self.next, number):
            self.early.setdefault(k, b"")
            self.partial.pop(k, None)

    def take(self) -> Iterator[tuple[int, bytes]]:
        """Yield the next messages in order, with their numbers."""
        while self.next in self.early:
            self.next += 1
            yield self.next - 1, self.early.pop(self.next - 1)


@dataclass
class _Peer:
    """Remote participant."""

    meta: tuple[str, int]  # address for discovery
    default: tuple[str, int]  # address for user traffic
    lease: float  # s
    until: float = 0.0  # end of the lease (monotonic) [s]


class ServiceServers:
    """Service servers that run in a separate thread."""

    def __init__(
        self,
        domain: int,
        host: str,
        services: Iterable[Service],
        request: Callable[[Service, bytes, str, Callable[[bytes], None]], None],
        left: Callable[[str], None] = lambda client: None,
    ) -> None:
        self._request, self._left, self._domain = request, left, domain
        self._is_local = ipaddress.ip_address(host).is_loopback
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
        self._socket.bind((host, 0))
        self._prefix = _NO_VENDOR + os.urandom(10)
        self._lock = threading.RLock()
        self._publications, self._subscriptions = _Writer(_PUBLICATIONS), _Writer(_SUBSCRIPTIONS)
        self._services: dict[bytes, Service] = {}  # keyed by request reader
        self._writers: dict[bytes, _Writer] = {_PUBLICATIONS: self._publications, _SUBSCRIPTIONS: self._subscriptions}
        self._topics: dict[str, bytes] = {}
        self._peers: dict[bytes, _Peer] = {}
        self._readers: dict[bytes, _Reader] = {}  # by remote writer
        self._clients: dict[bytes, bytes] = {}  # remote request writer -> our request reader
        address = socket.inet_aton(host).rjust(16, b"\0")
        self._locator = struct.pack("<iI", 1, self._socket.getsockname()[1]) + address
        for key, service in enumerate(services, 1):
            number = key.to_bytes(3, "big")
            self._services[number + _REQUESTS] = service
            self._writers[number + _RESPONSES] = _Writer(number + _RESPONSES, last=1)  # acknowledging 1 is a reply
            about = f"rq{service.name}Request", f"rr{service.name}Reply"
            for topic, type_, kind, writer in (
                (about[0], service.request, _REQUESTS, self._subscriptions),
                (about[1], service.response, _RESPONSES, self._publications),
            ):
                self._topics[topic] = number + kind
                writer.add(self._endpoint(number + kind, topic, type_name(type_)))
        self._counts = itertools.count(1)  # receivers ignore heartbeats and ACKNACKs whose count does not increase
        self._announced, self._ticked, self._vendor = 0.0, 0.0, _NO_VENDOR
        self._over = False
        self._thread = threading.Thread(target=self._run, name="services over DDS")
        self._thread.start()

    @property
    def guid(self) -> bytes:
        return self._prefix + _PARTICIPANT

    @property
    def readers(self) -> list[tuple[str, bytes]]:
        """Services with the GUIDs of their request readers."""
        return [(one.name, self._prefix + id_) for id_, one in self._services.items()]

    @property
    def writers(self) -> list[tuple[str, bytes]]:
        """Services with the GUIDs of their response writers."""
        return [(one.name, self._prefix + id_[:3] + _RESPONSES) for id_, one in self._services.items()]

    def close(self) -> None:
        self._over = True
        self._thread.join()
        self._socket.close()

    def _endpoint(self, id_: bytes, topic: str, type_: str) -> bytes:
        """Return the description of a local endpoint."""
        forever = struct.pack("<iI", 0x7FFFFFFF, 0xFFFFFFFF)
        found = {
            0x15: _VERSION,
            0x16: _NO_VENDOR,
            0x50: self.guid,
            _ENDPOINT: self._prefix + id_,
            _TOPIC: _text(topic),
            0x07: _text(type_),
            0x1D: struct.pack("<I", 0),
            0x1A: struct.pack("<I", 2) + forever,
            0x40: struct.pack("<II", 0, 10),
            0x2F: self._locator,
        }
        return _PL_CDR + b"".join(_parameter(*one) for one in found.items()) + _parameter(1, b"")

    def _announcement(self) -> bytes:
        found = {
            0x15: _VERSION,
            0x16: _NO_VENDOR,
            0x50: self.guid,
            0x32: self._locator,
            0x31: self._locator,
            0x02: struct.pack("<iI", _LEASE, 0),
            0x58: struct.pack("<I", _ENDPOINTS),
            0x2C: struct.pack("<I", 10) + b"enclave=/;",
        }
        payload = _PL_CDR + b"".join(_parameter(*one) for one in found.items()) + _parameter(1, b"")
        return self._packet(_data(_SPDP, 1, payload))

    def _packet(self, *messages: bytes, to: bytes = b"") -> bytes:
        destination = _message(_DESTINATION, 0, to) if to else b""
        return _HEADER + self._prefix + destination + b"".join(messages)

    def _send(self, packet: bytes, place: tuple[str, int]) -> None:
        with contextlib.suppress(OSError):  # no receiver or no route
            self._socket.sendto(packet, place)

    def _run(self) -> None:
        while not self._over:
            ready = select.select([self._socket], [], [], _TICK)[0]
            try:
                packet = self._socket.recv(65536) if ready else b""
                with self._lock:
                    self._tick(time.monotonic())
                    self._receive(packet)
            except (struct.error, IndexError, ValueError, OSError):  # not an RTPS packet
                continue
            except Exception:
                _logger.exception("services over DDS")

    def _tick(self, now: float) -> None:
        if now - self._announced > _ANNOUNCE:
            self._announced = now
            packet, first = self._announcement(), 7400 + 250 * self._domain
            if self._is_local:
                for k in range(_PARTICIPANTS):
                    self._send(packet, ("127.0.0.1", first + 10 + 2 * k))
            else:
                self._send(packet, ("239.255.0.1", first))
            for prefix in [prefix for prefix, peer in self._peers.items() if now > peer.until]:
                self._forget(prefix)
            for writer in [prefix + id_ for prefix in self._peers for id_ in (_PUBLICATIONS, _SUBSCRIPTIONS)]:
                reader = self._readers.setdefault(writer, _Reader())
                if reader.next == 1:  # a returning participant may assume that we still know its endpoints
                    self._acknowledge(writer, reader)
        if now - self._ticked > _TICK:
            self._ticked = now
            for writer in self._writers.values():
                for guid, number in writer.acknowledged.items():
                    if number < writer.last or guid not in writer.heard:
                        self._heartbeat(writer, guid)

    def _heartbeat(self, writer: _Writer, reader: bytes, *before: bytes) -> None:
        """Send a reader the given messages (if any), followed by a heartbeat that lists the available messages."""
        peer = self._peers.get(reader[:12])
        if peer is None:
            return
        first = max(writer.acknowledged.get(reader, 0) + 1, min(writer.messages, default=writer.last + 1))
        last = writer.last if reader in writer.heard else first - 1
        body = reader[12:] + writer.id + _sn(first) + _sn(last) + struct.pack("<i", next(self._counts))
        place = peer.meta if writer.id[3] == _SPDP[3] else peer.default
        self._send(self._packet(*before, _message(_HEARTBEAT, 0, body), to=reader[:12]), place)

    def _write(self, writer: _Writer, reader: bytes, numbers: Iterable[int]) -> None:
        """Send messages to a reader, followed by a heartbeat."""
        numbers = [k for k in numbers if k in writer.messages and reader in writer.heard]
        found = [_data(writer.id, k, *writer.messages[k]) for k in numbers]
        for k in range(0, max(len(found), 1), 8):
            self._heartbeat(writer, reader, *found[k : k + 8])

    def _forget(self, prefix: bytes) -> None:
        del self._peers[prefix]
        for writer in self._writers.values():
            for guid in [one for one in writer.acknowledged if one[:12] == prefix]:
                writer.forget(guid)
        for known in (self._readers, self._clients):
            for guid in [one for one in known if one[:12] == prefix]:
                del known[guid]
        self._left(prefix.hex())

    def _receive(self, packet: bytes) -> None:
        if packet[:4] != b"RTPS":
            return
        self._vendor, prefix, place, to = packet[6:8], packet[8:20], 20, self._prefix
        while place + 4 <= len(packet):
            kind, flags, size = packet[place], packet[place + 1], 0
            order = "<" if flags & 1 else ">"
            (size,) = struct.unpack_from(f"{order}H", packet, place + 2)
            body = packet[place + 4 : place + 4 + size] if size else packet[place + 4 :]
            place += 4 + len(body)
            if peer := self._peers.get(prefix):
                peer.until = time.monotonic() + peer.lease
            if kind == _DESTINATION:
                to = body[:12] if any(body[:12]) else self._prefix
            elif kind == _SOURCE:  # another participant in the same process
                self._vendor, prefix = body[6:8], body[8:20]
            elif to != self._prefix:
                continue
            elif kind == _DATA:
                self._take_data(prefix, flags, body, order)
            elif kind == _FRAGMENT:
                self._take_fragment(prefix, flags, body, order)
            elif kind == _HEARTBEAT:
                self._take_heartbeat(prefix, body, order)
            elif kind == _ACKNACK:
                self._take_acknack(prefix, body, order)
            elif kind == _GAP:
                self._take_gap(prefix, body, order)

    def _take_data(self, prefix: bytes, flags: int, body: bytes, order: str) -> None:
        (to_inline,) = struct.unpack_from(f"{order}H", body, 2)
        writer, (high, low) = body[8:12], struct.unpack_from(f"{order}iI", body, 12)
        number = (high << 32) + low
        inline, place = _inline(body, 4 + to_inline, flags, order)
        payload = body[place:] if flags & (4 | 8) else b""
        is_over = bool(inline.get(_STATUS, bytes(4))[3] & 3)  # disposed or unregistered
        if writer == _SPDP:
            self._take_participant(prefix, payload, is_over)
            return
        reader = self._known(prefix, writer)
        if reader is None:
            return
        if is_over:
            self._forget_endpoint(inline.get(_KEY) or dict(_listed(payload)).get(_ENDPOINT, b""))
            payload = b""
        reader.put(number, payload)
        self._accept(reader, prefix, writer)

    def _take_fragment(self, prefix: bytes, flags: int, body: bytes, order: str) -> None:
        (to_inline,) = struct.unpack_from(f"{order}H", body, 2)
        high, low, first, _, size, total = struct.unpack_from(f"{order}iIIHHI", body, 12)
        writer, number = body[8:12], (high << 32) + low
        reader = self._known(prefix, writer)
        if reader is not None:
            _, place = _inline(body, 4 + to_inline, flags, order)
            if payload := reader.join(number, total, size, first, body[place:]):
                reader.put(number, payload)
                self._accept(reader, prefix, writer)

    def _accept(self, reader: _Reader, prefix: bytes, writer: bytes) -> None:
        """Handle the next messages of a remote writer in order."""
        for k, one in reader.take():
            if one and writer in (_PUBLICATIONS, _SUBSCRIPTIONS):
                self._take_endpoint(writer, one)
            elif one:
                self._take_request(prefix + writer, k, one)

    def _forget_endpoint(self, guid: bytes) -> None:
        self._readers.pop(guid, None)
        self._clients.pop(guid, None)
        for writer in self._writers.values():
            writer.forget(guid)

    def _known(self, prefix: bytes, writer: bytes) -> _Reader | None:
        """Return the local reader of a remote writer, or None for an unknown writer."""
        if prefix in self._peers and writer in (_PUBLICATIONS, _SUBSCRIPTIONS):
            self._readers.setdefault(prefix + writer, _Reader())
        return self._readers.get(prefix + writer)

    def _take_participant(self, prefix: bytes, payload: bytes, is_over: bool) -> None:
        if is_over or not payload:
            if prefix in self._peers:
                self._forget(prefix)
            return
        order = "<" if payload[1] & 1 else ">"
        meta = default = None
        lease = float(_LEASE)  # upper limit, because goals of a crashed client continue until the lease expires
        for pid, value in _listed(payload):
            if pid == 0x32 and meta is None:
                meta = self._place(value, order)
            elif pid == 0x31 and default is None:
                default = self._place(value, order)
            elif pid == 0x02:
                lease = min(lease, float(struct.unpack_from(f"{order}i", value)[0]))
        if meta is None or default is None or (prefix not in self._peers and len(self._peers) >= _MOST):
            return
        is_new = prefix not in self._peers
        self._peers[prefix] = _Peer(meta, default, lease, time.monotonic() + lease)
        if is_new:
            self._send(self._announcement(), meta)
            for writer in (self._publications, self._subscriptions):
                guid = prefix + writer.id[:3] + b"\xc7"
                writer.acknowledged[guid] = 0
                writer.heard.add(guid)  # this reader has history
                self._write(writer, guid, range(1, writer.last + 1))

    def _place(self, locator: bytes, order: str) -> tuple[str, int] | None:
        kind, port = struct.unpack_from(f"{order}iI", locator)
        if kind != 1:
            return None
        return ("127.0.0.1" if self._is_local else socket.inet_ntoa(locator[20:24])), port

    def _take_endpoint(self, writer: bytes, payload: bytes) -> None:
        """Register an endpoint of a client: its request writer or its response reader."""
        found = dict(_listed(payload))
        topic, guid = found.get(_TOPIC, b"")[4:].rstrip(b"\0").decode(errors="replace"), found.get(_ENDPOINT, b"")
        ours = self._topics.get(topic)
        if ours is None or len(guid) < 16 or guid[:12] not in self._peers or len(self._clients) >= _MOST:
            return
        if writer == _PUBLICATIONS and ours[3:] == _REQUESTS:
            self._clients[guid] = ours
            self._acknowledge(guid, self._readers.setdefault(guid, _Reader()))
        elif writer == _SUBSCRIPTIONS and ours[3:] == _RESPONSES:
            sent = self._writers[ours]
            if guid not in sent.acknowledged and len(sent.acknowledged) >= _MOST:
                return
            waiting = [k for k, owner in sent.owners.items() if owner == guid[:12]]
            sent.acknowledged.setdefault(guid, waiting[0] - 1 if waiting else sent.last)
            self._heartbeat(sent, guid)

    def _take_heartbeat(self, prefix: bytes, body: bytes, order: str) -> None:
        writer, (high, low, high_last, low_last) = body[4:8], struct.unpack_from(f"{order}iIiI", body, 8)
        reader = self._known(prefix, writer)
        if reader is None:
            return
        first, last = (high << 32) + low, (high_last << 32) + low_last
        reader.skip(first)
        self._accept(reader, prefix, writer)
        if self._known(prefix, writer) is reader:
            self._acknowledge(prefix + writer, reader, last)

    def _acknowledge(self, writer: bytes, reader: _Reader, last: int = 0) -> None:
        """Send a remote writer the numbers of the missing messages; the writer then sends these messages or reports a
        gap."""
        held = [k for k in range(reader.next, min(last + 1, reader.next + _WINDOW)) if k not in reader.early]
        missing = [k for k in held if k not in reader.partial]
        ours = self._clients.get(writer, writer[12:15] + b"\xc7") + writer[12:]
        count = struct.pack("<i", next(self._counts))
        is_final = bool(last) and not held
        body = ours + _sn(reader.next) + _set(reader.next, missing) + count
        messages = [_message(_ACKNACK, 2 * is_final, body)]
        for number, (_, parts) in reader.partial.items():
            first = min(parts)
            wanted = _set(first, [k for k in parts if k < first + _WINDOW])
            body = ours + _sn(number) + struct.pack("<I", first) + wanted + count
            messages.append(_message(_NACK_FRAGMENT, 0, body))
        peer = self._peers[writer[:12]]
        place = peer.meta if writer[15] == _SPDP[3] else peer.default
        self._send(self._packet(*messages, to=writer[:12]), place)

    def _take_acknack(self, prefix: bytes, body: bytes, order: str) -> None:
        reader, writer = prefix + body[:4], self._writers.get(body[4:8])
        high, low = struct.unpack_from(f"{order}iI", body, 8)
        if writer is None or reader not in writer.acknowledged:
            return
        base = (high << 32) + low
        writer.acknowledged[reader] = max(writer.acknowledged[reader], base - 1)
        wanted = _members(base, body, 16, order)
        if reader not in writer.heard and base > writer.acknowledged[reader]:
            writer.heard.add(reader)
            wanted = list(range(writer.acknowledged[reader] + 1, writer.last + 1))
        if wanted:
            self._write(writer, reader, wanted)

    def _take_gap(self, prefix: bytes, body: bytes, order: str) -> None:
        writer, (high, low, high_last, low_last) = body[4:8], struct.unpack_from(f"{order}iIiI", body, 8)
        reader = self._known(prefix, writer)
        if reader is None:
            return
        start, base = (high << 32) + low, (high_last << 32) + low_last
        if start <= reader.next:
            reader.skip(base)
        for k in (*range(max(start, reader.next), min(base, reader.next + _WINDOW)), *_members(base, body, 24, order)):
            reader.put(k, b"")
        self._accept(reader, prefix, writer)

    def _take_request(self, client: bytes, number: int, payload: bytes) -> None:
        ours = self._clients.get(client)
        if ours is None:
            return
        header = inline = b""
        if self._vendor == _CYCLONE:
            header, payload = payload[_CLIENT], payload[:4] + payload[_CLIENT.stop :]
        else:
            inline = b"".join(_parameter(pid, client + _sn(number)) for pid in _RELATED)
        send = partial(self._respond, ours[:3] + _RESPONSES, client[:12], header, inline)
        self._request(self._services[ours], payload, client[:12].hex(), send)

    def _respond(self, id_: bytes, owner: bytes, header: bytes, inline: bytes, cdr: bytes) -> None:
        """Send a response to all clients of the service; may be called from any thread."""
        cdr = cdr[:4] + header + cdr[4:]
        with self._lock:
            writer = self._writers[id_]
            number = writer.add(cdr, inline)
            writer.owners[number] = owner
            for known in (writer.messages, writer.owners):
                known.pop(number - _KEPT, None)
            for reader in list(writer.acknowledged):
                self._write(writer, reader, [number])
