"""`Ros1Process`: between the loop's feed and a node of ROS 1: a program under the system's Python."""

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
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import IO, Any

from armlab.bridge.loop_end import LoopEnd
from armlab.bridge.messages import Listening, Report
from armlab.bridge.outlet import pair
from armlab.bridge.ros import Commands, Encoded, Topics, store
from armlab.bridge.ros1 import relay
from armlab.errors import CommandRefused, LinkError
from armlab.robots import from_toml

__all__ = ["Ros1Process", "serve"]

_BUFFER = 2**19  # bytes that wait for the relay: about 1 s of two topics
_SAYING = 65535
_START = 8.0  # s for the relay to be a node
_END = 2.0  # s for it to end by itself
_SPOKEN = 1.0  # s between two sentences to one node
_CLIENTS = 256  # of which it is known when they were answered


class Ros1Process:
    """Serves until the loop closes the feed.

    Parameters
    ----------
    feed : connected to the loop.
    options : "master", its URI; "python", which has rospy; "host", the address that other nodes reach us by.

    Raises
    ------
    LinkError : the loop has gone.
    """

    def __init__(self, feed: socket.socket, options: Mapping[str, Any]) -> None:
        self._options = options
        self._lost: Counter[str] = Counter()
        self._sent: Counter[str] = Counter()
        self._loop = LoopEnd(feed, lambda: {name: (self._sent[name], self._lost[name]) for name in self._sent})
        about = self._loop.about
        robots = {name: from_toml(text, name) for name, text in about["robots"].items()}
        self._topics, self._commands = Topics(robots, self._loop.schema), Commands(about["cell"], robots)
        self._encoded = Encoded(self._topics, _encoded)
        self._numbers = {name: number for number, name in enumerate(self._topics.published)}
        self._wanted: frozenset[str] = frozenset()
        self._spoken: dict[str, float] = {}

    def run(self) -> None:
        """Serve until the loop closes the feed.

        Raises
        ------
        LinkError : no rospy, no master, or it has gone.
        """
        own = tempfile.TemporaryDirectory(prefix="armlab-ros-", ignore_cleanup_errors=True)
        with own as home, tempfile.TemporaryFile() as log, self._relay(home, log) as node:
            self._begin(node, log)
            while True:
                ready, _, _ = select.select([self._loop, node], [], [], 1.0)
                if node in ready:
                    self._hear(node, log)
                messages = self._loop.receive()
                if messages is None:
                    return
                for message in messages:
                    self._pass_on(node, message)
                if not messages:
                    self._send(node, self._encoded.of_silence(time.monotonic_ns(), self._wanted))

    @contextlib.contextmanager
    def _relay(self, home: str, log: IO[bytes]) -> Iterator[socket.socket]:
        """Start the node; it ends with its input."""
        ours, theirs = pair()
        ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
        master, host = self._options["master"], self._options["host"]
        own = {"ROS_MASTER_URI": master, "ROS_IP": host, "ROS_HOME": home}
        environment = {name: value for name, value in os.environ.items() if name not in _NOT_INHERITED}
        with theirs:
            try:
                process = subprocess.Popen(
                    [self._options["python"], relay.__file__],
                    stdin=theirs.fileno(),
                    stdout=theirs.fileno(),
                    stderr=log,
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

    def _begin(self, node: socket.socket, log: IO[bytes]) -> None:
        """Tell the node what there is, and the loop that it is one."""
        published = {name: _old(one.type) for name, one in self._topics.published.items()}
        taken = {name: _old(type_) for name, type_ in self._commands.types.items()}
        about = {"node": f"armlab_{self._loop.about['cell'].replace('-', '_')}", "published": published, "taken": taken}
        with contextlib.suppress(OSError):  # it has ended: its words say why
            node.send(json.dumps(about).encode())
        if not select.select([node], [], [], _START)[0]:
            raise LinkError(f"Expected a node of ROS 1 within {_START:g} s, but nothing came. Look at the master.")
        (ready,) = self._messages(node, log)[:1]
        master = self._options["master"]
        without = f", not installed: {', '.join(ready['missing'])}" if ready["missing"] else ""
        self._loop.ask(Listening(where=[f"{self._options['host']} (ros1, master {master}{without})"]))

    def _messages(self, node: socket.socket, log: IO[bytes]) -> list[dict[str, Any]]:
        """Return what the node says now; raise what it said last when it has ended."""
        found: list[dict[str, Any]] = []
        with contextlib.suppress(BlockingIOError):
            for _ in range(64):
                try:
                    data = node.recv(2**17)
                except ConnectionError:
                    data = b""
                if not data:
                    log.seek(0)
                    words = log.read().decode(errors="replace").strip().splitlines()
                    raise LinkError(words[-1] if words else "Expected the node of ROS 1 to go on, but it ended.")
                found.append(json.loads(data))
        return found

    def _hear(self, node: socket.socket, log: IO[bytes]) -> None:
        for message in self._messages(node, log):
            if message["kind"] == "wanted":
                new = frozenset(message["topics"]) - self._wanted
                self._wanted = frozenset(message["topics"])
                self._send(node, self._encoded.of_parameters(self._loop.parameters, new))
            elif message["kind"] == "command":
                try:
                    for request in self._commands.requests(message["topic"], message["content"], message["client"]):
                        self._loop.ask(request)
                except CommandRefused as error:
                    self._answer(node, message["client"], str(error))
                    self._loop.ask(Report(message["client"], str(error)))

    def _pass_on(self, node: socket.socket, message: bytes | dict[str, Any]) -> None:
        if isinstance(message, bytes):
            self._send(node, self._encoded.of_row(message, self._wanted))
        elif message["kind"] == "parameters":
            self._send(node, self._encoded.of_parameters(self._loop.parameters, self._wanted))
        elif message["kind"] == "answer":
            self._answer(node, message["client"], message["text"])

    def _answer(self, node: socket.socket, client: str, text: str) -> None:
        """Write a sentence for a node into the log of ROS, at most once a second."""
        now = time.monotonic()
        if now - self._spoken.get(client, -_SPOKEN) >= _SPOKEN:
            self._spoken.pop(client, None)
            if len(self._spoken) >= _CLIENTS:
                del self._spoken[next(iter(self._spoken))]  # who was answered longest ago
            self._spoken[client] = now
            with contextlib.suppress(OSError):
                node.send(struct.pack("<H", _SAYING) + f"{client}: {text}".encode())

    def _send(self, node: socket.socket, messages: Any) -> None:
        for published, raw in messages:
            name = published.name
            self._sent[name] += 0
            try:
                node.send(struct.pack("<H", self._numbers[name]) + raw)
                self._sent[name] += 1
            except OSError:  # the relay does not read, or has ended, which the next look tells
                self._lost[name] += 1


def serve(feed: socket.socket, options: Mapping[str, Any]) -> None:
    """Serve until the loop closes the feed.

    Parameters
    ----------
    feed : connected to the loop. options : see `Ros1Process`.

    Raises
    ------
    LinkError : see `Ros1Process.run`.
    """
    Ros1Process(feed, options).run()


def _encoded(message: Any, type_: str) -> bytes:
    """Return a message as ROS 1 has it."""
    return bytes(store().cdr_to_ros1(store().serialize_cdr(message, type_), type_))


def _old(type_: str) -> str:
    return type_.replace("/msg/", "/")


_NOT_INHERITED = ("PYTHONHOME", "VIRTUAL_ENV", "ROS_HOSTNAME", "ROS_NAMESPACE", "ROS_LOG_DIR")
