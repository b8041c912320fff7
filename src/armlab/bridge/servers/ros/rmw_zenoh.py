"""`RmwZenohServer`: ROS 2 nodes with rmw_zenoh read and command, without a ROS installation here."""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Literal, NamedTuple

from armlab.bridge.net.sockets import is_here
from armlab.bridge.servers.messages import Listening
from armlab.bridge.servers.ros.server import RosServer
from armlab.bridge.servers.ros.topics import RosTopic, domain_number, store, type_name
from armlab.bridge.servers.zenoh.messages import data_of
from armlab.bridge.servers.zenoh.session import Publisher, close_session, open_near, zenoh
from armlab.errors import ConfigError, MissingExtra

ANY = "*"
"""In place of a hash in the key of a reader: writers of every distribution."""

Distribution = Literal["humble", "jazzy", "kilted"]
"""Of ROS 2: Humble knows no hashes of types."""

_RELIABLE, _BEST_EFFORT = "::,10:,:,:,,", "2::,1:,:,:,,"  # volatile; keep the last 10, the last 1
_NO_HASH = "TypeHashNotSupported"
_ID = 16
_ORIGIN = struct.Struct(f"<qqB{_ID}s")


class Names:
    """Keys of one node."""

    def __init__(self, domain: int, session: str, distribution: Distribution = "jazzy", node: str = "armlab") -> None:
        self._domain, self._node, self._has_hashes = domain, node, distribution != "humble"
        self._graph = f"@ros2_lv/{domain}/{session}"

    def hash(self, type: str) -> str:
        """Return what stands for the definition of a message type."""
        return store().hash_rihs01(type) if self._has_hashes else _NO_HASH

    def data(self, topic: str, type: str, hash: str = "") -> str:
        """Return the key of a topic's messages."""
        return f"{self._domain}/{topic.strip('/')}/{type_name(type)}/{hash or self.hash(type)}"

    def node(self) -> str:
        """Return the token of the node, whose number is 0."""
        return f"{self._graph}/0/0/NN/%/%/{self._node}"

    def writers(self) -> str:
        """Return what the tokens of all writers of the domain match."""
        return f"@ros2_lv/{self._domain}/*/*/*/MP/**"

    def writer(self, number: int, topic: str, type: str) -> str:
        """Return the token of a reliable writer that keeps the last ten."""
        return self._endpoint(number, "MP", topic, type, _RELIABLE)

    def reader(self, number: int, topic: str, type: str) -> str:
        """Return the token of a best-effort reader of the last one."""
        return self._endpoint(number, "MS", topic, type, _BEST_EFFORT)

    def _endpoint(self, number: int, kind: str, topic: str, type: str, quality: str) -> str:
        about = f"{topic.replace('/', '%')}/{type_name(type)}/{self.hash(type)}/{quality}"
        return f"{self._graph}/0/{number}/{kind}/%/%/{self._node}/{about}"


class Origin(NamedTuple):
    """What is attached to a message: its number from 1, when it was written [ns], and who wrote it (16 bytes)."""

    seq: int
    stamp_ns: int
    writer: bytes

    def pack(self) -> bytes:
        return _ORIGIN.pack(self.seq, self.stamp_ns, _ID, self.writer)

    @classmethod
    def read(cls, data: bytes | None) -> Origin | None:
        """Return what the bytes say; None for others, whose message is dropped as rmw_zenoh drops it."""
        if data is None or len(data) != _ORIGIN.size:
            return None
        seq, stamp_ns, size, writer = _ORIGIN.unpack(data)
        return cls(seq, stamp_ns, writer) if size == _ID else None

    @property
    def client(self) -> str:
        """The writer as people read it: all of its id, so that no two are one."""
        return self.writer.hex()


class Writer:
    """Numbers the messages of one writer."""

    def __init__(self, token: str) -> None:
        self.id = _hashed(token)
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
            "Expected xxhash to speak with rmw_zenoh, got none. Install it: pip install 'armlab[net]'."
        ) from None
    value: Any = xxhash.xxh3_128_intdigest(token.encode())
    return value.to_bytes(_ID, "little")


_MOST = 4096  # writers that are known; more are a flood


class Nodes:
    """Nodes that have writers. A message says its writer, a hash of the writer's token; the token says its node.

    All writers of a node are one client: with one it commands, with another it sets a parameter.
    """

    def __init__(self, left: Callable[[str], None]) -> None:
        self._left = left
        self._clients: dict[bytes, str] = {}

    def token(self, token: str, is_there: bool) -> None:
        """Take note of a writer's token that has come or gone."""
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
        """Return who wrote a message, ``/NODE@SESSION``; the writer itself when no token of it is known."""
        return self._clients.get(origin.writer, origin.client)


_LOOK = 1.0  # s between two looks at who reads
_MAY_COME_AGAIN = 30.0  # s after a reader: what it misses while its router starts anew must show in the numbers


class RmwZenohServer(RosServer):
    """Speaks as a node with rmw_zenoh, in a domain, that of ROS_DOMAIN_ID when None."""

    def __init__(self, feed: socket.socket, options: Mapping[str, Any]) -> None:
        self._outputs: dict[str, Publisher] = {}
        self._writers: dict[str, Writer] = {}
        self._wanted: frozenset[str] = frozenset()
        self._read_until: dict[str, float] = {}
        self._reading = threading.Lock()
        super().__init__(feed, self._counts)
        self._domain, self._looked = domain_number(options["domain"]), 0.0
        router, commands = options["router"], "rmw_zenoh" in self._loop.about.get("commands", ())
        if router and commands and not is_here(router):
            raise ConfigError(
                f"Expected no commands through a router elsewhere ({router}), since ROS nodes prove nothing. Take "
                "rmw_zenoh out of `commands`, or let them come through an SSH tunnel."
            )
        self._session, self._where = open_near(options["host"], options["port"], router, commands=commands)
        self._names = Names(self._domain, str(self._session.zid()), options["distribution"])
        self._nodes = Nodes(self.left)
        self._declared: list[Any] = []  # tokens and readers: they go with the last that holds them

    def run(self) -> None:
        try:
            self._declare()
            self._loop.ask(Listening(where=[f"{self._where}, rmw_zenoh, domain {self._domain}"]))
            self.serve(self._look)
        finally:
            close_session(self._session)

    def wanted(self) -> frozenset[str]:
        """Return the names of the topics that somebody reads, or has read a moment ago."""
        return self._wanted

    def write(self, topic: RosTopic, cdr: bytes) -> None:
        self._outputs[topic.name].put(cdr, self._writers[topic.name].next(time.time_ns()))

    def _look(self) -> None:
        """Note who reads, also while parameters are published more often than that."""
        now = time.monotonic()
        if now - self._looked > _LOOK:
            self._looked = now
            self._read()

    def _counts(self) -> dict[str, tuple[int, int]]:
        """Return messages sent by topic: who reads them, and what is dropped for whom, is not known here."""
        return {name: (output.sent, output.dropped) for name, output in self._outputs.items() if output.sent}

    def _declare(self) -> None:
        """Enter the graph: the node, its writers, its readers."""
        session, names = self._session, self._names
        tokens, number = [names.node()], 0
        for number, one in enumerate(self._topics.published.values(), 1):
            token = names.writer(number, one.name, one.type)
            self._writers[one.name] = Writer(token)
            self._outputs[one.name] = Publisher(session, names.data(one.name, one.type), self._read)
            tokens.append(token)
        self._read()
        lives = session.liveliness()
        self._declared.append(lives.declare_subscriber(names.writers(), self._token, history=True))
        for count, (topic, type_) in enumerate(self._commands.types.items(), number + 1):
            tokens.append(names.reader(count, topic, type_))
            key = names.data(topic, type_, ANY)
            self._declared.append(session.declare_subscriber(key, partial(self._take, topic)))
        self._declared += [lives.declare_token(token) for token in tokens]

    def _read(self) -> None:
        """Take note of what is read now; by any thread.

        A reader whose way is cut is as one that has left. What it would have got is numbered still, for a while.
        """
        now = time.monotonic()
        with self._reading:
            read = [name for name, output in list(self._outputs.items()) if output.wanted]
            self._read_until.update(dict.fromkeys(read, now + _MAY_COME_AGAIN))
            self._wanted = frozenset([name for name, until in self._read_until.items() if until > now])

    def _token(self, sample: Any) -> None:
        self._nodes.token(str(sample.key_expr), sample.kind == zenoh().SampleKind.PUT)

    def _take(self, topic: str, sample: Any) -> None:
        """Take a message of a node; called by a thread of Zenoh's."""
        origin = Origin.read(data_of(sample.attachment))
        if origin is None:  # rmw_zenoh drops it, too: who sent it is not known
            self.refuse("unknown", f"Expected 33 bytes attached on {topic}, as rmw_zenoh has them since June 2025.")
        else:
            self.take(topic, sample.payload.to_bytes(), self._nodes.client(origin))
