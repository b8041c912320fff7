"""`DdsServer`: ROS 2 nodes read and command over DDS, without a ROS installation here."""

from __future__ import annotations

import socket
import time
from collections.abc import Mapping
from typing import Any

from armlab.bridge.loop_end import LoopEnd
from armlab.bridge.messages import Leave, Listening, Report
from armlab.bridge.ros.dds_domain import joined
from armlab.bridge.ros.dds_topics import Readers, Writers
from armlab.bridge.ros.mould import cdr
from armlab.bridge.ros.requests import Commands
from armlab.bridge.ros.ros2 import content, domain_number
from armlab.bridge.ros.topics import Encoded, Topics
from armlab.errors import CommandRefused
from armlab.robots import from_toml

__all__ = ["DdsServer", "serve"]

_AGAIN = 1.0  # s after which the parameters are told again, for readers that came later


class DdsServer:
    """Serves until the loop closes the feed.

    Parameters
    ----------
    feed : connected to the loop; see `feed.Exchange`.
    options : "domain", None for that of ROS_DOMAIN_ID, and "host", IPv4 address of the interface.

    Raises
    ------
    LinkError : the loop has gone before it said what rows hold. ConfigError : ROS_DOMAIN_ID is no number.
    """

    def __init__(self, feed: socket.socket, options: Mapping[str, Any]) -> None:
        self._domain, self._host = domain_number(options["domain"]), options["host"]
        self._writers: Writers | None = None
        self._loop = LoopEnd(feed, lambda: {} if self._writers is None else dict(self._writers.counts))
        about = self._loop.about
        robots = {name: from_toml(text, f"the bridge of {about['cell']}") for name, text in about["robots"].items()}
        self._topics = Topics(robots, self._loop.schema)
        self._encoded = Encoded(self._topics, cdr)
        self._commands = Commands(about["cell"], robots)
        self._told = 0.0

    @property
    def wanted(self) -> frozenset[str]:
        """Names of the topics that somebody reads."""
        return frozenset() if self._writers is None else self._writers.wanted

    def run(self) -> None:
        """Serve until the loop closes the feed."""
        with joined(self._domain, self._host) as participant:
            writers = Writers(participant, self._topics.published)
            readers = Readers(participant, self._commands.types, self._take, self._left)
            self._writers = writers
            try:
                self._loop.ask(Listening(where=[f"{self._host} (ros2, DDS domain {self._domain})"]))
                self._serve(writers)
            finally:
                readers.close()
                writers.close()

    def _serve(self, writers: Writers) -> None:
        while (messages := self._loop.receive(_AGAIN)) is not None:
            for message in messages:
                if isinstance(message, bytes):
                    for topic, made in self._encoded.of_row(message, writers.wanted):
                        writers.write(topic, made)
                else:
                    self._text(message)
            if time.monotonic() - self._told > _AGAIN:
                self._tell_parameters(writers)

    def _text(self, message: Mapping[str, Any]) -> None:
        if message["kind"] == "parameters" and self._writers is not None:
            self._tell_parameters(self._writers)
        elif message["kind"] == "answer":
            self._answer(message["client"], message["text"])

    def _tell_parameters(self, writers: Writers) -> None:
        self._told = time.monotonic()
        for topic, made in self._encoded.of_parameters(self._loop.parameters, writers.wanted):
            writers.write(topic, made)
        for topic, made in self._encoded.of_silence(time.monotonic_ns(), writers.wanted):
            writers.write(topic, made)

    def _take(self, name: str, cdr: bytes, client: str) -> None:
        """Pass what a node wants on to the loop; called by threads of DDS."""
        try:
            for request in self._commands.requests(name, content(self._commands.types[name], cdr), client):
                self._loop.ask(request)
        except CommandRefused as error:
            self._answer(client, str(error))
            self._loop.ask(Report(client, str(error)))

    def _left(self, client: str) -> None:
        self._loop.ask(Leave(client))

    def _answer(self, client: str, text: str) -> None:
        """Tell a node; nothing leads back to it but the diagnostics, which all read."""
        self._topics.answer = f"{client}: {text}"


def serve(feed: socket.socket, options: Mapping[str, Any]) -> None:
    """Serve until the loop closes the feed.

    Parameters
    ----------
    feed : connected to the loop. options : see `DdsServer`.

    Raises
    ------
    LinkError : the loop has gone, or the sockets cannot be kept to this computer.
    """
    DdsServer(feed, options).run()
