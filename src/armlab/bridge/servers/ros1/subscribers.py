"""`Subscribers`: the connections by which nodes of ROS 1 read our topics. Nothing here waits for a node."""

from __future__ import annotations

import contextlib
import select
import socket
import struct
from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import fields

from armlab.bridge.servers.ros.topics import Topic
from armlab.bridge.servers.ros.types import store

__all__ = ["Subscribers"]

_ROOM = 500  # messages that wait for a slow node: 2 s of one topic
_SEND_BUFFER = 65536  # bytes; with the system's own a slow node would see data half a minute old
_MOST = 64  # connections
_SIZE = struct.Struct("<I")
_SIZE_AND_SEQ = struct.Struct("<II")


class Subscribers:
    """Writes messages to whoever reads their topic; for a slow node they wait, and the oldest are dropped."""

    def __init__(self, looks: select.poll) -> None:
        self.wanted: frozenset[str] = frozenset()
        self.counts: dict[str, tuple[int, int]] = {}
        self._looks = looks
        self._connections: dict[int, _Connection] = {}
        self._readers: dict[str, tuple[_Connection, ...]] = {}
        self._seq: Counter[str] = Counter()
        self._headed: dict[str, bool] = {}

    def add(self, topic: str, connection: socket.socket, known: Iterable[bytes] = ()) -> str:
        """Take a connection over, on which the header of ROS has gone out.

        Returns why it was ended instead, a sentence; nothing when it was taken.

        topic : full name. connection : of TCP. known : messages without a header that only this node gets.
        """
        one = _Connection(topic, connection)
        if len(self._connections) >= _MOST:
            one.close()
            return f"Expected at most {_MOST} connections of nodes, got one more. End one that nobody needs."
        with contextlib.suppress(OSError):  # it has gone, which the first look tells
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # else messages wait for acknowledgements
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
        self._connections[connection.fileno()] = one
        self._looks.register(connection, select.POLLIN)
        self._sort()
        for raw in known:
            self._put(one, _SIZE.pack(len(raw)) + raw)
        return ""

    def send(self, topic: Topic, raw: bytes) -> None:
        """Send a message to all nodes that read it; their connections that have ended are let go.

        topic : of the message. raw : the message as ROS 1 has it; its number is set here.
        """
        name = topic.name
        headed = self._headed.get(name)
        if headed is None:
            headed = self._headed[name] = fields(store().types[topic.type])[0].name == "header"
        self._seq[name] = (self._seq[name] + 1) % 2**32
        data = _SIZE_AND_SEQ.pack(len(raw), self._seq[name]) + raw[4:] if headed else _SIZE.pack(len(raw)) + raw
        for one in self._readers.get(name, ()):
            self._put(one, data)

    def look(self, number: int) -> None:
        """See what has become of a connection: there is room again, or it has ended, as nodes only read."""
        one = self._connections.get(number)
        if one is not None:
            self._put(one, None)
            if one.has_ended():
                self._let_go(one)

    def close(self) -> None:
        """End all connections."""
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
            self._sort()

    def _count(self, one: _Connection, added: int, dropped: int) -> None:
        sent, lost = self.counts.get(one.topic, (0, 0))
        self.counts[one.topic] = sent + added - dropped, lost + dropped

    def _sort(self) -> None:
        held = list(self._connections.values())
        self.wanted = frozenset(one.topic for one in held)
        self._readers = {name: tuple(one for one in held if one.topic == name) for name in self.wanted}


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
        """Write what waits, as far as there is room. OSError when it has ended."""
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
