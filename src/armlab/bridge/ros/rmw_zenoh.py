"""`RmwZenohServer`: ROS 2 nodes with rmw_zenoh read and command, without a ROS installation here."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Mapping
from functools import partial
from typing import Any

from armlab.bridge.listening import is_here
from armlab.bridge.loop_end import LoopEnd
from armlab.bridge.messages import Leave, Listening, Report
from armlab.bridge.ros.mould import cdr
from armlab.bridge.ros.requests import Commands
from armlab.bridge.ros.rmw_zenoh_names import ANY, Names, Origin, Writer
from armlab.bridge.ros.rmw_zenoh_nodes import Nodes
from armlab.bridge.ros.ros2 import content, domain_number
from armlab.bridge.ros.topics import Encoded, Published, Topics
from armlab.bridge.zenoh.output import Output
from armlab.bridge.zenoh.session import close_session, data_of, open_near, zenoh
from armlab.errors import CommandRefused, ConfigError
from armlab.robots import from_toml

__all__ = ["RmwZenohServer", "serve"]

_AGAIN = 1.0  # s after which the parameters are told again, for readers that came later
_MAY_COME_AGAIN = 30.0  # s after a reader: what it misses while its router starts anew must show in the numbers


class RmwZenohServer:
    """Serves until the loop closes the feed.

    Parameters
    ----------
    feed : connected to the loop; see `feed.Exchange`.
    options : "domain", None for that of ROS_DOMAIN_ID, "host", "port", "router" and "distribution".

    Attributes
    ----------
    wanted : names of the topics that somebody reads, or has read in the last half minute.

    Raises
    ------
    LinkError : the loop has gone, or the port is taken. ConfigError : ROS_DOMAIN_ID is no number, or commands
        could come through a router elsewhere.
    MissingExtra : Zenoh or xxhash is not installed.
    """

    def __init__(self, feed: socket.socket, options: Mapping[str, Any]) -> None:
        self._outputs: dict[str, Output] = {}
        self._writers: dict[str, Writer] = {}
        self.wanted: frozenset[str] = frozenset()
        self._read_until: dict[str, float] = {}
        self._reading = threading.Lock()
        self._loop = LoopEnd(feed, self._counts)
        about = self._loop.about
        robots = {name: from_toml(text, f"the bridge of {about['cell']}") for name, text in about["robots"].items()}
        self._topics, self._commands = Topics(robots, self._loop.schema), Commands(about["cell"], robots)
        self._encoded = Encoded(self._topics, cdr)
        self._domain, self._told = domain_number(options["domain"]), 0.0
        self._looked = 0.0
        router, commands = options["router"], "rmw_zenoh" in about.get("commands", ())
        if router and commands and not is_here(router):
            raise ConfigError(
                f"Expected no commands through a router elsewhere ({router}), since ROS nodes prove nothing. Take "
                "rmw_zenoh out of `commands`, or let them come through an SSH tunnel."
            )
        self._session, self._where = open_near(options["host"], options["port"], router, commands=commands)
        self._names = Names(self._domain, str(self._session.zid()), options["distribution"])
        self._nodes = Nodes(self._left)
        self._declared: list[Any] = []  # tokens and readers: they go with the last that holds them

    def run(self) -> None:
        """Serve until the loop closes the feed."""
        try:
            self._declare()
            self._loop.ask(Listening(where=[f"{self._where}, rmw_zenoh, domain {self._domain}"]))
            while (messages := self._loop.receive(_AGAIN)) is not None:
                for message in messages:
                    if isinstance(message, bytes):
                        for topic, made in self._encoded.of_row(message, self.wanted):
                            self._write(topic, made)
                    elif message["kind"] == "parameters":
                        self._tell_parameters()
                    elif message["kind"] == "answer":
                        self._answer(message["client"], message["text"])
                now = time.monotonic()
                if now - self._looked > _AGAIN:  # also while parameters are told more often than that
                    self._looked = now
                    self._read()
                if now - self._told > _AGAIN:
                    self._tell_parameters()
        finally:
            close_session(self._session)

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
            self._outputs[one.name] = Output(session, names.data(one.name, one.type), self._read)
            tokens.append(token)
        self._read()
        lives = session.liveliness()
        self._declared.append(lives.declare_subscriber(names.writers(), self._token, history=True))
        for count, (topic, type_) in enumerate(self._commands.types.items(), number + 1):
            tokens.append(names.reader(count, topic, type_))
            key = names.data(topic, type_, ANY)
            self._declared.append(session.declare_subscriber(key, partial(self._take, topic, type_)))
        self._declared += [lives.declare_token(token) for token in tokens]

    def _read(self) -> None:
        """Take note of what is read now: the same set until it changes, as `Encoded` likes it; by any thread.

        A reader whose way is cut is as one that has left. What it would have got is numbered still, for a while.
        """
        now = time.monotonic()
        with self._reading:
            read = [name for name, output in list(self._outputs.items()) if output.wanted]
            self._read_until.update(dict.fromkeys(read, now + _MAY_COME_AGAIN))
            wanted = frozenset([name for name, until in self._read_until.items() if until > now])
            if wanted != self.wanted:
                self.wanted = wanted

    def _token(self, sample: Any) -> None:
        self._nodes.token(str(sample.key_expr), sample.kind == zenoh().SampleKind.PUT)

    def _left(self, client: str) -> None:
        self._loop.ask(Leave(client))

    def _write(self, topic: Published, data: bytes) -> None:
        self._outputs[topic.name].put(data, self._writers[topic.name].next(time.time_ns()))

    def _tell_parameters(self) -> None:
        self._told = time.monotonic()
        for topic, made in self._encoded.of_parameters(self._loop.parameters, self.wanted):
            self._write(topic, made)
        for topic, made in self._encoded.of_silence(time.monotonic_ns(), self.wanted):
            self._write(topic, made)

    def _take(self, topic: str, type: str, sample: Any) -> None:
        """Pass what a node wants on to the loop; called by a thread of Zenoh's."""
        origin = Origin.read(data_of(sample.attachment))
        if origin is None:  # rmw_zenoh drops it, too: who sent it is not known
            self._refuse("unknown", f"Expected 33 bytes attached on {topic}, as rmw_zenoh has them since June 2025.")
            return
        client = self._nodes.client(origin)
        try:
            for request in self._commands.requests(topic, content(type, sample.payload.to_bytes()), client):
                self._loop.ask(request)
        except CommandRefused as error:
            self._refuse(client, str(error))

    def _refuse(self, client: str, why: str) -> None:
        self._answer(client, why)
        self._loop.ask(Report(client, why))

    def _answer(self, client: str, text: str) -> None:
        """Tell a node; nothing leads back to it but the diagnostics, which all read."""
        self._topics.answer = f"{client}: {text}"


def serve(feed: socket.socket, options: Mapping[str, Any]) -> None:
    """Serve until the loop closes the feed.

    Parameters
    ----------
    feed : connected to the loop. options : see `RmwZenohServer`.

    Raises
    ------
    LinkError, ConfigError, MissingExtra : see `RmwZenohServer`.
    """
    RmwZenohServer(feed, options).run()
