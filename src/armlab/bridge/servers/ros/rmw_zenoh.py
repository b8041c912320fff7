"""`RmwZenohServer`: ROS 2 server over rmw_zenoh for rows and commands; requires no ROS installation."""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from itertools import count
from typing import Any, Literal, NamedTuple

from armlab.bridge.net.sockets import is_here
from armlab.bridge.servers.messages import Listening
from armlab.bridge.servers.ros.actions import TRAJECTORY
from armlab.bridge.servers.ros.server import RosServer
from armlab.bridge.servers.ros.services import Service
from armlab.bridge.servers.ros.topics import RosTopic, domain_number, store, type_name
from armlab.bridge.servers.zenoh.messages import data_of
from armlab.bridge.servers.zenoh.session import LatchedPublisher, Publisher, close_session, open_near, zenoh
from armlab.errors import ConfigError, MissingExtra

ANY = "*"
"""Wildcard for the type hash in a reader's key, which matches writers of all distributions."""

Distribution = Literal["humble", "jazzy", "kilted"]
"""ROS 2 distribution (Humble has no type hashes)."""

_RELIABLE, _BEST_EFFORT = "::,10:,:,:,,", "2::,1:,:,:,,"  # volatile, keep last 10; volatile, keep last 1
_LATCHED = ":1:,1:,:,:,,"  # reliable, transient local, keep last
_NO_HASH = "TypeHashNotSupported"
_ID = 16
_ORIGIN = struct.Struct(f"<qqB{_ID}s")


class Names:
    """Keys and liveliness tokens of one node, identified by its number in the session."""

    def __init__(
        self, domain: int, session: str, distribution: Distribution = "jazzy", node: str = "armlab", number: int = 0
    ) -> None:
        self._domain, self._node, self._has_hashes = domain, node, distribution != "humble"
        self._graph = f"@ros2_lv/{domain}/{session}/{number}"
        self._number = number

    def hash(self, type: str) -> str:
        """Return the hash of a message type (a fixed string for Humble)."""
        return store().hash_rihs01(type) if self._has_hashes else _NO_HASH

    def data(self, topic: str, type: str, hash: str = "") -> str:
        """Return the key of a topic's messages."""
        return f"{self._domain}/{topic.strip('/')}/{type_name(type)}/{hash or self.hash(type)}"

    def node(self) -> str:
        return f"{self._graph}/{self._number}/NN/%/%/{self._node}"

    def writers(self) -> tuple[str, str]:
        """Return the key expressions that match the tokens of all writers and all service clients in the domain."""
        return f"@ros2_lv/{self._domain}/*/*/*/MP/**", f"@ros2_lv/{self._domain}/*/*/*/SC/**"

    def writer(self, number: int, topic: str, type: str, is_latched: bool = False) -> str:
        """Return the token of a reliable writer with history depth 10, or of a writer that latches its last message."""
        return self._endpoint(number, "MP", topic, type, _LATCHED if is_latched else _RELIABLE)

    def reader(self, number: int, topic: str, type: str) -> str:
        """Return the token of a reader: best effort with depth 1, or reliable with depth 10 for trajectories."""
        return self._endpoint(number, "MS", topic, type, _RELIABLE if type == TRAJECTORY else _BEST_EFFORT)

    def service(self, number: int, name: str, type: str) -> str:
        """Return the liveliness token of a service server."""
        return self._endpoint(number, "SS", name, type, _RELIABLE)

    def _endpoint(self, number: int, kind: str, topic: str, type: str, quality: str) -> str:
        about = f"{topic.replace('/', '%')}/{type_name(type)}/{self.hash(type)}/{quality}"
        return f"{self._graph}/{number}/{kind}/%/%/{self._node}/{about}"


class Origin(NamedTuple):
    """Attachment of a message: its number (from 1), write time [ns], and writer id (16 bytes)."""

    seq: int
    stamp_ns: int
    writer: bytes

    def pack(self) -> bytes:
        return _ORIGIN.pack(self.seq, self.stamp_ns, _ID, self.writer)

    @classmethod
    def read(cls, data: bytes | None) -> Origin | None:
        """Return the attachment in `data`, or None if it is invalid (rmw_zenoh also drops such messages)."""
        if data is None or len(data) != _ORIGIN.size:
            return None
        seq, stamp_ns, size, writer = _ORIGIN.unpack(data)
        return cls(seq, stamp_ns, writer) if size == _ID else None

    @property
    def client(self) -> str:
        """Complete, unique writer id in hexadecimal."""
        return self.writer.hex()


class Writer:
    """Assigns numbers to the messages of one writer."""

    def __init__(self, token: str) -> None:
        self.id: bytes = _hashed(token)
        self._seq = 0

    def next(self, stamp_ns: int) -> bytes:
        """Return the attachment of the next message."""
        self._seq += 1
        return _ORIGIN.pack(self._seq, stamp_ns, _ID, self.id)


def _hashed(token: str) -> bytes:
    try:
        import xxhash
    except ImportError:
        raise MissingExtra(
            "Expected the package xxhash for rmw_zenoh, but it is not installed. Install it: pip install 'armlab[net]'."
        ) from None
    value: Any = xxhash.xxh3_128_intdigest(token.encode())
    return value.to_bytes(_ID, "little")


_MOST = 4096  # maximum number of known writers; more are treated as a flood


class Nodes:
    """Nodes, keyed by the ids of their writers and service clients; all writers of a node count as one client."""

    def __init__(self, left: Callable[[str], None]) -> None:
        self._left = left
        self._clients: dict[bytes, str] = {}

    def token(self, token: str, is_there: bool) -> None:
        """Add or remove a writer by its token."""
        words = token.split("/")
        if len(words) < 9:
            return
        writer = Writer(token).id
        if is_there:
            if len(self._clients) < _MOST:
                self._clients[writer] = f"{words[7].replace('%', '/').rstrip('/')}/{words[8]}@{words[2]}"
        elif (client := self._clients.pop(writer, None)) is not None and client not in list(self._clients.values()):
            self._left(client)

    def client(self, origin: Origin) -> str:
        """Return the node that sent a message, ``/NODE@SESSION``, or the writer id if its token is unknown."""
        return self._clients.get(origin.writer, origin.client)


_CHECK_EVERY = 1.0  # s between checks of the readers
_MAY_RETURN = 30.0  # s; numbering continues after a reader leaves, to reveal messages missed while a router restarts


class RmwZenohServer(RosServer):
    """ROS 2 server compatible with rmw_zenoh; if `domain` is None, ROS_DOMAIN_ID is used."""

    def __init__(self, feed: socket.socket, options: Mapping[str, Any]) -> None:
        self._outputs: dict[str, Publisher] = {}
        self._writers: dict[str, Writer] = {}
        self._wanted: frozenset[str] = frozenset()
        self._read_until: dict[str, float] = {}
        self._reading = threading.Lock()
        super().__init__(feed, self._counts, options.get("tf", False))
        self._domain, self._checked = domain_number(options["domain"]), 0.0
        router, commands = options["router"], "rmw_zenoh" in self._loop.about.get("commands", ())
        if router and commands and not is_here(router):
            raise ConfigError(
                f"Expected a router on this computer, got {router}: ROS nodes do not authenticate, so "
                "a cell whose `commands` lists rmw_zenoh must not accept commands from other computers. "
                "Remove rmw_zenoh from `commands`, or connect nodes through an SSH tunnel."
            )
        self._session, self._where = open_near(options["host"], options["port"], router, commands=commands)
        about = self._domain, str(self._session.zid()), options["distribution"]
        self._names = {node: Names(*about, node, number) for number, node in enumerate(self.nodes)}
        self._nodes = Nodes(self.left)
        self._declared: list[Any] = []  # tokens and readers; deleting the last reference undeclares them

    def run(self) -> None:
        try:
            self._declare()
            self._loop.ask(Listening(where=[f"{self._where}, rmw_zenoh, domain {self._domain}"]))
            self.serve(self._check)
        finally:
            close_session(self._session)

    def wanted(self) -> frozenset[str]:
        """Return the names of the topics that have readers, or had readers recently."""
        return self._wanted

    def write(self, topic: RosTopic, cdr: bytes) -> None:
        self._outputs[topic.name].put(cdr, self._writers[topic.name].next(time.time_ns()))

    def _check(self) -> None:
        """Update the set of topics with readers, at most once per second."""
        now = time.monotonic()
        if now - self._checked > _CHECK_EVERY:
            self._checked = now
            self._read()

    def _counts(self) -> dict[str, tuple[int, int]]:
        """Return the numbers of messages sent and dropped by topic; losses at the readers are unknown."""
        return {name: (output.sent, output.dropped) for name, output in self._outputs.items() if output.sent}

    def _declare(self) -> None:
        """Join the graph by declaring the nodes with their writers, readers and services."""
        session, lives, latched = self._session, self._session.liveliness(), self.latched
        tokens, numbers = [names.node() for names in self._names.values()], count(len(self.nodes))
        for one in self.published.values():
            names = self._names[self.node_of(one.name)]
            is_latched, key = one.name in latched, names.data(one.name, one.type)
            token = names.writer(next(numbers), one.name, one.type, is_latched)
            self._writers[one.name] = Writer(token)
            self._outputs[one.name] = (
                LatchedPublisher(session, key) if is_latched else Publisher(session, key, self._read)
            )
            tokens.append(token)
        self._read()
        for key in self._names[self.nodes[0]].writers():
            self._declared.append(lives.declare_subscriber(key, self._token, history=True))
        for topic, type_ in (self._commands.types | self._goals.topics).items():
            names = self._names[self.node_of(topic)]
            tokens.append(names.reader(next(numbers), topic, type_))
            key = names.data(topic, type_, ANY)
            self._declared.append(session.declare_subscriber(key, partial(self._take, topic)))
        for service in self.services:
            names = self._names[self.node_of(service.name)]
            tokens.append(names.service(next(numbers), service.name, service.type))
            key = names.data(service.name, service.type, ANY)
            self._declared.append(session.declare_queryable(key, partial(self._answer, service), complete=True))
        self.send_latched()
        self._declared += [lives.declare_token(token) for token in tokens]

    def _read(self) -> None:
        """Update the set of topics with readers; keep each topic for a while after its last reader disconnects.
        Thread-safe."""
        now = time.monotonic()
        with self._reading:
            read = [name for name, output in list(self._outputs.items()) if output.wanted]
            self._read_until.update(dict.fromkeys(read, now + _MAY_RETURN))
            self._wanted = frozenset([name for name, until in self._read_until.items() if until > now])

    def _token(self, sample: Any) -> None:
        self._nodes.token(str(sample.key_expr), sample.kind == zenoh().SampleKind.PUT)

    def _answer(self, service: Service, query: Any) -> None:
        """Answer a node's request; called from a Zenoh thread."""
        origin, payload = Origin.read(data_of(query.attachment)), data_of(query.payload)
        if origin is None or payload is None:
            self.refuse("unknown", f"Expected a request to {service.name} with an attachment of 33 bytes.")
            return

        def send(cdr: bytes) -> None:
            query.reply(query.key_expr, cdr, attachment=origin._replace(stamp_ns=time.time_ns()).pack())

        self.request(service, payload, self._nodes.client(origin), send)

    def _take(self, topic: str, sample: Any) -> None:
        """Handle a node's message; called from a Zenoh thread."""
        origin = Origin.read(data_of(sample.attachment))
        if origin is None:  # unknown sender: rmw_zenoh also drops such messages
            self.refuse(
                "unknown", f"Expected an attachment of 33 bytes on {topic}, as sent by rmw_zenoh since June 2025."
            )
        else:
            self.take(topic, sample.payload.to_bytes(), self._nodes.client(origin))
