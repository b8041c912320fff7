"""`Ros1Process`: server process between the loop and a ROS 1 node, which runs under the system's Python."""

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

_ROOM = 500  # maximum number of messages queued for a slow node: 2 s of data on one topic
_SEND_BUFFER = 65536  # bytes; with the default size, a slow node would receive data that is 30 s old
_MOST = 64  # maximum number of connections
_SIZE = struct.Struct("<I")
_SIZE_AND_SEQ = struct.Struct("<II")


class Subscribers:
    """Connections of subscribing nodes; messages for a slow node are queued, and the oldest are dropped."""

    def __init__(self, poller: select.poll) -> None:
        self.counts: dict[str, tuple[int, int]] = {}
        self._poller = poller
        self._connections: dict[int, _Connection] = {}
        self._seq: Counter[str] = Counter()

    @property
    def wanted(self) -> frozenset[str]:
        return frozenset(one.topic for one in self._connections.values())

    def add(self, topic: str, connection: socket.socket, known: Iterable[bytes] = ()) -> str:
        """Add a connection whose ROS header has been sent; return "" or the reason for refusal."""
        one = _Connection(topic, connection)
        if len(self._connections) >= _MOST:
            one.close()
            return f"Expected at most {_MOST} node connections. Close one."
        with contextlib.suppress(OSError):  # already closed, which the first poll reports
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # otherwise messages wait for an ACK
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
        self._connections[connection.fileno()] = one
        self._poller.register(connection, select.POLLIN)
        for raw in known:
            self._put(one, _SIZE.pack(len(raw)) + raw)
        return ""

    def send(self, topic: RosTopic, raw: bytes) -> None:
        """Send a message to all subscribers; remove closed connections."""
        name = topic.name
        headed = fields(store().types[topic.type])[0].name == "header"
        self._seq[name] = (self._seq[name] + 1) % 2**32
        data = _SIZE_AND_SEQ.pack(len(raw), self._seq[name]) + raw[4:] if headed else _SIZE.pack(len(raw)) + raw
        for one in [one for one in self._connections.values() if one.topic == name]:
            self._put(one, data)

    def check(self, number: int) -> None:
        """Handle a polled connection that has become writable again or has been closed."""
        one = self._connections.get(number)
        if one is not None:
            self._put(one, None)
            if one.has_ended():
                self._remove(one)

    def close(self) -> None:
        for one in list(self._connections.values()):
            self._remove(one)

    def _put(self, one: _Connection, data: bytes | None) -> None:
        was_behind = bool(one.waiting)
        if data is not None:
            self._count(one, 1, one.add(data))
        try:
            one.write()
        except OSError:
            self._remove(one)
            return
        if was_behind != bool(one.waiting):
            self._poller.modify(one.socket, select.POLLIN | (select.POLLOUT if one.waiting else 0))

    def _remove(self, one: _Connection) -> None:
        if self._connections.pop(one.socket.fileno(), None) is not None:
            self._poller.unregister(one.socket)
            if one.waiting:
                self._count(one, 0, len(one.waiting))
            one.close()

    def _count(self, one: _Connection, added: int, dropped: int) -> None:
        sent, lost = self.counts.get(one.topic, (0, 0))
        self.counts[one.topic] = sent + added - dropped, lost + dropped


class _Connection:
    """Connection and queue of one node."""

    def __init__(self, topic: str, connection: socket.socket) -> None:
        self.topic, self.socket = topic, connection
        self.waiting: deque[bytes] = deque()

    def add(self, data: bytes) -> int:
        """Queue a message; return the number of dropped messages."""
        dropped = len(self.waiting) > _ROOM
        if dropped:
            del self.waiting[1]  # the first message may be partly sent
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
        """Shut down the connection, because rospy holds the same socket."""
        with contextlib.suppress(OSError):  # already closed
            self.socket.shutdown(socket.SHUT_RDWR)
        self.socket.close()


_POLL = 1000  # ms
_START = 8.0  # s for the relay to register its node
_END = 2.0  # s for the relay to exit
_ANSWER_EVERY = 1.0  # s between answers to one node
_CLIENTS = 256  # maximum number of clients whose last answer time is kept
_SENTENCE = 1000  # maximum length of an answer in characters


class Ros1Process(RosServer):
    """Server process, which runs until the loop closes the socket."""

    def __init__(self, feed: socket.socket, options: Mapping[str, Any]) -> None:
        self._options = options
        self._poller = select.poll()
        self._subscribers = Subscribers(self._poller)
        super().__init__(feed, lambda: self._subscribers.counts)
        self._answered: dict[str, float] = {}
        self._node: socket.socket  # our end of the relay's socket
        self._log: IO[bytes]  # standard error of the relay

    def wanted(self) -> frozenset[str]:
        return self._subscribers.wanted

    def write(self, topic: RosTopic, cdr: bytes) -> None:
        self._subscribers.send(topic, _ros1(topic, cdr))

    def run(self) -> None:
        own = tempfile.TemporaryDirectory(prefix="armlab-ros-", ignore_cleanup_errors=True)
        held = contextlib.closing(self._subscribers)
        with own as home, tempfile.TemporaryFile() as self._log, self._relay(home) as self._node, held:
            self._begin()
            self._poller.register(self._loop, select.POLLIN)
            self._poller.register(self._node, select.POLLIN)
            while True:
                for number, _ in self._poller.poll(_POLL):
                    if number == self._node.fileno():
                        self._receive()
                    elif number != self._loop.fileno():
                        self._subscribers.check(number)
                messages = self._loop.receive()
                if messages is None:
                    return
                for message in messages:
                    self.publish(message)
                if not messages:
                    self.send(self._topics.of_silence(time.monotonic_ns(), self.wanted()))

    @contextlib.contextmanager
    def _relay(self, home: str) -> Iterator[socket.socket]:
        """Start the relay, which exits when its input closes."""
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
                    f"Expected a Python with rospy at {self._options['python']}, got {error.strerror}. Set `python`."
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
        """Send the topics to the node, wait until the node is ready, and report to the loop that the server is
        listening."""
        kept = self._topics.latched  # in ROS 1, the description is a parameter of the master
        published = {name: _old(one.type) for name, one in self._topics.published.items() if name not in kept}
        taken = {name: _old(type_) for name, type_ in self._commands.types.items()}
        about = {"node": f"armlab_{self._loop.about['cell'].replace('-', '_')}", "published": published, "taken": taken}
        with contextlib.suppress(OSError):  # the relay has exited; its output explains why
            self._node.send(json.dumps(about).encode())
        until = time.monotonic() + _START
        messages: list[dict[str, Any]] = []
        while not (ready := [message for message in messages if message["kind"] == "ready"]):
            left = until - time.monotonic()
            if left < 0.0 or not select.select([self._node], [], [], left)[0]:
                raise LinkError(f"Expected a ROS 1 node within {_START:g} s, got none. Check the master.")
            messages += self._messages()
        master, missing = self._options["master"], ready[0]["missing"]
        without = f", not installed: {', '.join(missing)}" if missing else ""
        self._loop.ask(Listening(where=[f"{self._options['host']} (ros1, master {master}{without})"]))
        self._receive(messages)

    def _messages(self) -> list[dict[str, Any]]:
        """Return the messages received from the node; if it has exited, raise an error with its last output."""
        found: list[dict[str, Any]] = []
        with contextlib.suppress(BlockingIOError):
            for _ in range(64):
                try:
                    data, connections, _, _ = socket.recv_fds(self._node, 2**17, 1)
                except ConnectionError:
                    data, connections = b"", []
                if not data:
                    self._log.seek(0)
                    output = self._log.read().decode(errors="replace").strip().splitlines()
                    raise LinkError(output[-1] if output else "Expected the ROS 1 node to keep running, but it exited.")
                try:
                    found.append({**json.loads(data), "connections": connections})
                except ValueError as error:
                    self._loop.ask(Report(text=f"Expected JSON from the ROS 1 node, got {error}."))
        return found

    def _receive(self, messages: Iterable[Mapping[str, Any]] = ()) -> None:
        """Handle the given messages, or newly received messages, from the node: subscribers, commands and refused
        messages."""
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
        """Start writing to a subscriber; return "" or the reason for refusal."""
        if not message["connections"]:
            return "Expected a free file descriptor for the connection, got none. Raise `ulimit -n`."
        topic = message["topic"]
        known = [
            _ros1(one, store().serialize_cdr(parameters, one.type))
            for one, parameters in self._topics.of_parameters(self._loop.parameters, {topic})
        ]
        return self._subscribers.add(topic, socket.socket(fileno=message["connections"][0]), known)

    def answer(self, client: str, text: str) -> None:
        """Write an answer for a node to the ROS log, at most once per second."""
        now = time.monotonic()
        if now - self._answered.get(client, -_ANSWER_EVERY) >= _ANSWER_EVERY:
            self._answered.pop(client, None)
            if len(self._answered) >= _CLIENTS:
                del self._answered[next(iter(self._answered))]  # the least recently answered client
            self._answered[client] = now
            with contextlib.suppress(OSError):
                self._node.send(json.dumps({"text": f"{client}: {text}"[:_SENTENCE]}).encode())


def _ros1(topic: RosTopic, cdr: bytes) -> bytes:
    return bytes(store().cdr_to_ros1(cdr, topic.type))


def _old(type_: str) -> str:
    return type_.replace("/msg/", "/")


_NOT_INHERITED = ("PYTHONHOME", "VIRTUAL_ENV", "ROS_HOSTNAME", "ROS_IPV6", "ROS_NAMESPACE", "ROS_LOG_DIR")
