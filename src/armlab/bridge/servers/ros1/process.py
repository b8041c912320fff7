"""`Ros1Process`: between the loop's feed and a node of ROS 1, a program under the system's Python."""

from __future__ import annotations

import contextlib
import json
import os
import select
import socket
import struct
import subprocess
import tempfile
import time
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import fields
from typing import IO, Any

from armlab.bridge.net.sockets import pair
from armlab.bridge.servers.messages import Listening, Report
from armlab.bridge.servers.ros.server import RosServer
from armlab.bridge.servers.ros.topics import RosTopic, store
from armlab.bridge.servers.ros1 import relay
from armlab.errors import LinkError

_ROOM = 500  # messages that wait for a slow node: 2 s of one topic
_SEND_BUFFER = 65536  # bytes; with the system's own a slow node would see data half a minute old
_MOST = 64  # connections
_SIZE = struct.Struct("<I")
_SIZE_AND_SEQ = struct.Struct("<II")


class Subscribers:
    """Writes messages to whoever reads their topic; for a slow node they wait, and the oldest are dropped."""

    def __init__(self, looks: select.poll) -> None:
        self.counts: dict[str, tuple[int, int]] = {}
        self._looks = looks
        self._connections: dict[int, _Connection] = {}
        self._seq: Counter[str] = Counter()

    @property
    def wanted(self) -> frozenset[str]:
        return frozenset(one.topic for one in self._connections.values())

    def add(self, topic: str, connection: socket.socket, known: Iterable[bytes] = ()) -> str:
        """Take over a connection whose header of ROS has gone out; return a sentence when it was ended instead."""
        one = _Connection(topic, connection)
        if len(self._connections) >= _MOST:
            one.close()
            return f"Expected at most {_MOST} connections of nodes, got one more. End one that nobody needs."
        with contextlib.suppress(OSError):  # it has gone, which the first look tells
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # else messages wait for acknowledgements
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
        self._connections[connection.fileno()] = one
        self._looks.register(connection, select.POLLIN)
        for raw in known:
            self._put(one, _SIZE.pack(len(raw)) + raw)
        return ""

    def send(self, topic: RosTopic, raw: bytes) -> None:
        """Send a message to all nodes that read it; their connections that have ended are let go."""
        name = topic.name
        headed = fields(store().types[topic.type])[0].name == "header"
        self._seq[name] = (self._seq[name] + 1) % 2**32
        data = _SIZE_AND_SEQ.pack(len(raw), self._seq[name]) + raw[4:] if headed else _SIZE.pack(len(raw)) + raw
        for one in [one for one in self._connections.values() if one.topic == name]:
            self._put(one, data)

    def look(self, number: int) -> None:
        """See what has become of a connection: there is room again, or it has ended, as nodes only read."""
        one = self._connections.get(number)
        if one is not None:
            self._put(one, None)
            if one.has_ended():
                self._let_go(one)

    def close(self) -> None:
        for one in list(self._connections.values()):
            self._let_go(one)

    def _put(self, one: _Connection, data: bytes | None) -> None:
        was_behind = bool(one.waiting)
        if data is not None:
            self._count(one, 1, one.add(data))
        try:
            one.write()
        except OSError:
            self._let_go(one)
            return
        if was_behind != bool(one.waiting):
            self._looks.modify(one.socket, select.POLLIN | (select.POLLOUT if one.waiting else 0))

    def _let_go(self, one: _Connection) -> None:
        if self._connections.pop(one.socket.fileno(), None) is not None:
            self._looks.unregister(one.socket)
            if one.waiting:
                self._count(one, 0, len(one.waiting))
            one.close()

    def _count(self, one: _Connection, added: int, dropped: int) -> None:
        sent, lost = self.counts.get(one.topic, (0, 0))
        self.counts[one.topic] = sent + added - dropped, lost + dropped


class _Connection:
    """The connection of one node, and what waits for it."""

    def __init__(self, topic: str, connection: socket.socket) -> None:
        self.topic, self.socket = topic, connection
        self.waiting: deque[bytes] = deque()

    def add(self, data: bytes) -> int:
        """Let this wait; return how many messages were dropped."""
        dropped = len(self.waiting) > _ROOM
        if dropped:
            del self.waiting[1]  # of the first one some may have gone out
        self.waiting.append(data)
        return int(dropped)

    def write(self) -> None:
        while self.waiting:
            data = self.waiting[0]
            try:
                written = self.socket.send(data, socket.MSG_DONTWAIT)
            except BlockingIOError:
                break
            if written < len(data):
                self.waiting[0] = data[written:]
                break
            self.waiting.popleft()

    def has_ended(self) -> bool:
        try:
            return not self.socket.recv(4096, socket.MSG_DONTWAIT)
        except BlockingIOError:
            return False
        except OSError:
            return True

    def close(self) -> None:
        """End the connection, of which rospy holds the same socket."""
        with contextlib.suppress(OSError):  # it has ended
            self.socket.shutdown(socket.SHUT_RDWR)
        self.socket.close()


_LOOK = 1000  # ms of one look
_START = 8.0  # s for the relay to be a node
_END = 2.0  # s for it to end by itself
_SPOKEN = 1.0  # s between two sentences to one node
_CLIENTS = 256  # of which it is known when they were answered
_SENTENCE = 1000  # characters of an answer


class Ros1Process(RosServer):
    """Serves until the loop closes the feed."""

    def __init__(self, feed: socket.socket, options: Mapping[str, Any]) -> None:
        self._options = options
        self._looks = select.poll()
        self._subscribers = Subscribers(self._looks)
        super().__init__(feed, lambda: self._subscribers.counts)
        self._spoken: dict[str, float] = {}
        self._node: socket.socket  # our end of the pipe to the relay
        self._log: IO[bytes]  # what it writes to standard error

    def wanted(self) -> frozenset[str]:
        return self._subscribers.wanted

    def write(self, topic: RosTopic, cdr: bytes) -> None:
        self._subscribers.send(topic, _ros1(topic, cdr))

    def run(self) -> None:
        own = tempfile.TemporaryDirectory(prefix="armlab-ros-", ignore_cleanup_errors=True)
        held = contextlib.closing(self._subscribers)
        with own as home, tempfile.TemporaryFile() as self._log, self._relay(home) as self._node, held:
            self._begin()
            self._looks.register(self._loop, select.POLLIN)
            self._looks.register(self._node, select.POLLIN)
            while True:
                for number, _ in self._looks.poll(_LOOK):
                    if number == self._node.fileno():
                        self._hear()
                    elif number != self._loop.fileno():
                        self._subscribers.look(number)
                messages = self._loop.receive()
                if messages is None:
                    return
                for message in messages:
                    self.pass_on(message)
                if not messages:
                    self.send(self._topics.of_silence(time.monotonic_ns(), self.wanted()))

    @contextlib.contextmanager
    def _relay(self, home: str) -> Iterator[socket.socket]:
        """Start the node; it ends with its input."""
        ours, theirs = pair()
        master, host = self._options["master"], self._options["host"]
        own = {"ROS_MASTER_URI": master, "ROS_IP": host, "ROS_HOME": home}
        environment = {name: value for name, value in os.environ.items() if name not in _NOT_INHERITED}
        with theirs:
            try:
                process = subprocess.Popen(
                    [self._options["python"], relay.__file__],
                    stdin=theirs.fileno(),
                    stdout=theirs.fileno(),
                    stderr=self._log,
                    env={**environment, **own},
                    cwd=home,
                )
            except OSError as error:
                ours.close()
                raise LinkError(
                    f"Expected a Python with rospy at {self._options['python']}, but {error.strerror}. Set `python`."
                ) from None
        try:
            yield ours
        finally:
            ours.close()
            try:
                process.wait(_END)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def _begin(self) -> None:
        """Tell the node what there is, and the loop that it is one."""
        published = {name: _old(one.type) for name, one in self._topics.published.items()}
        taken = {name: _old(type_) for name, type_ in self._commands.types.items()}
        about = {"node": f"armlab_{self._loop.about['cell'].replace('-', '_')}", "published": published, "taken": taken}
        with contextlib.suppress(OSError):  # it has ended: its words say why
            self._node.send(json.dumps(about).encode())
        until = time.monotonic() + _START
        messages: list[dict[str, Any]] = []
        while not (ready := [message for message in messages if message["kind"] == "ready"]):
            left = until - time.monotonic()
            if left < 0.0 or not select.select([self._node], [], [], left)[0]:
                raise LinkError(f"Expected a node of ROS 1 within {_START:g} s, but none came. Look at the master.")
            messages += self._messages()
        master, missing = self._options["master"], ready[0]["missing"]
        without = f", not installed: {', '.join(missing)}" if missing else ""
        self._loop.ask(Listening(where=[f"{self._options['host']} (ros1, master {master}{without})"]))
        self._hear(messages)

    def _messages(self) -> list[dict[str, Any]]:
        """Return what the node says now; raise what it said last when it has ended."""
        found: list[dict[str, Any]] = []
        with contextlib.suppress(BlockingIOError):
            for _ in range(64):
                try:
                    data, connections, _, _ = socket.recv_fds(self._node, 2**17, 1)
                except ConnectionError:
                    data, connections = b"", []
                if not data:
                    self._log.seek(0)
                    words = self._log.read().decode(errors="replace").strip().splitlines()
                    raise LinkError(words[-1] if words else "Expected the node of ROS 1 to go on, but it ended.")
                try:
                    found.append({**json.loads(data), "connections": connections})
                except ValueError as error:
                    self._loop.ask(Report(text=f"Expected JSON from the node of ROS 1, but {error}."))
        return found

    def _hear(self, messages: Iterable[Mapping[str, Any]] = ()) -> None:
        """Take what the node says, now or before: who reads a topic, or what another node commands."""
        for message in messages or self._messages():
            client = message.get("client", "")
            if message["kind"] == "subscriber":
                if why := self._connect(message):
                    self.refuse(client, why)
                    with contextlib.suppress(OSError):
                        self._node.send(json.dumps({"topic": message["topic"], "id": message["id"]}).encode())
            elif message["kind"] == "refused":
                self.refuse(client, message["text"])
            elif message["kind"] == "command":
                self.take(message["topic"], message["content"], client)

    def _connect(self, message: Mapping[str, Any]) -> str:
        """Write to a node from now on; a sentence when that cannot be: it would wait for ever."""
        if not message["connections"]:
            return "Expected room for the connection in the server's process, got none. Raise `ulimit -n`."
        topic = message["topic"]
        known = [
            _ros1(one, store().serialize_cdr(parameters, one.type))
            for one, parameters in self._topics.of_parameters(self._loop.parameters, {topic})
        ]
        return self._subscribers.add(topic, socket.socket(fileno=message["connections"][0]), known)

    def answer(self, client: str, text: str) -> None:
        """Write a sentence for a node into the log of ROS, at most once a second."""
        now = time.monotonic()
        if now - self._spoken.get(client, -_SPOKEN) >= _SPOKEN:
            self._spoken.pop(client, None)
            if len(self._spoken) >= _CLIENTS:
                del self._spoken[next(iter(self._spoken))]  # who was answered longest ago
            self._spoken[client] = now
            with contextlib.suppress(OSError):
                self._node.send(json.dumps({"text": f"{client}: {text}"[:_SENTENCE]}).encode())


def _ros1(topic: RosTopic, cdr: bytes) -> bytes:
    """Return a message as ROS 1 has it on the wire."""
    return bytes(store().cdr_to_ros1(cdr, topic.type))


def _old(type_: str) -> str:
    return type_.replace("/msg/", "/")


_NOT_INHERITED = ("PYTHONHOME", "VIRTUAL_ENV", "ROS_HOSTNAME", "ROS_IPV6", "ROS_NAMESPACE", "ROS_LOG_DIR")
