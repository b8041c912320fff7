"""`RosServer`: what the servers of ROS 2 over DDS and over Zenoh have in common, between the loop and a transport."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable

from armlab.bridge.servers.messages import Leave, Report
from armlab.bridge.servers.ros.requests import Commands
from armlab.bridge.servers.ros.topics import Messages, RosTopic, Topics, content, store
from armlab.bridge.servers.server_end import Clients, LoopEnd
from armlab.errors import CommandRefused

__all__ = ["RosServer"]

_AGAIN = 1.0  # s after which the parameters are published again, for readers that came later


class RosServer:
    """Messages of rows to a transport, and requests of nodes to the loop. `write` and `wanted` are the transport's."""

    def __init__(self, feed: socket.socket, clients: Callable[[], Clients]) -> None:
        self._loop = LoopEnd(feed, clients)
        robots = self._loop.robots()
        self._topics, self._commands = Topics(robots, self._loop.schema), Commands(self._loop.about["cell"], robots)
        self._told = 0.0

    def wanted(self) -> frozenset[str]:
        """Return the names of the topics that somebody reads."""
        raise NotImplementedError

    def write(self, topic: RosTopic, cdr: bytes) -> None:
        """Send one message."""
        raise NotImplementedError

    def serve(self, look: Callable[[], None] = lambda: None) -> None:
        """Serve until the loop closes the feed; `look` is called at least once a second."""
        while (messages := self._loop.receive(_AGAIN)) is not None:
            for message in messages:
                if isinstance(message, bytes):
                    self._write(self._topics.of_row(message, self.wanted()))
                elif message["kind"] == "parameters":
                    self._tell_parameters()
                elif message["kind"] == "answer":
                    self._answer(message["client"], message["text"])
            look()
            if time.monotonic() - self._told > _AGAIN:
                self._tell_parameters()

    def take(self, topic: str, cdr: bytes, client: str) -> None:
        """Pass a message of a node on to the loop; called by threads of the transport."""
        try:
            for request in self._commands.requests(topic, content(self._commands.types[topic], cdr), client):
                self._loop.ask(request)
        except CommandRefused as error:
            self.refuse(client, str(error))

    def refuse(self, client: str, why: str) -> None:
        """Tell a node and the log of the run why its message was not taken."""
        self._answer(client, why)
        self._loop.ask(Report(client, why))

    def left(self, client: str) -> None:
        """Tell the loop that a client has gone; called by threads of the transport."""
        self._loop.ask(Leave(client))

    def _answer(self, client: str, text: str) -> None:
        """Answer in the diagnostics, which all nodes read: no other message leads back to a node."""
        self._topics.answer = f"{client}: {text}"

    def _write(self, messages: Messages) -> None:
        for topic, message in messages:
            self.write(topic, bytes(store().serialize_cdr(message, topic.type)))

    def _tell_parameters(self) -> None:
        self._told = time.monotonic()
        wanted = self.wanted()
        self._write(self._topics.of_parameters(self._loop.parameters, wanted))
        self._write(self._topics.of_silence(time.monotonic_ns(), wanted))
