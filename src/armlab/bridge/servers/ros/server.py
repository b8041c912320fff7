"""What nodes of ROS may send, and `RosServer`: what its servers have in common, between the loop and a transport."""

from __future__ import annotations

import json
import math
import reprlib
import socket
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import msgspec
import numpy as np

from armlab.bridge.control.limits import joint_name
from armlab.bridge.servers.messages import CommandRequest, Leave, Report, Request, SetRequest, Stop
from armlab.bridge.servers.ros.topics import Messages, RosTopic, Topics, content, store
from armlab.bridge.servers.server_end import Clients, LoopEnd
from armlab.errors import CommandRefused
from armlab.robots import Robot

_KINDS = {"position": "q", "velocity": "qd", "effort": "tau"}
_SPELLINGS = ("command", "commands")  # of ROS 1 and of ROS 2
_NUMBERS, _TEXT, _EMPTY = "std_msgs/msg/Float64MultiArray", "std_msgs/msg/String", "std_msgs/msg/Empty"
_LONGEST = 65536  # characters of a text
_NUMERIC = {int, float, type(None)}  # not bool, which is an int; null is a number that is not finite


class Commands:
    """The topics that are listened to."""

    def __init__(self, cell: str, robots: Mapping[str, Robot]) -> None:
        self._robots = dict(robots)
        self._orders: dict[str, tuple[str, tuple[str, ...]]] = {}
        groups: dict[str, tuple[str, ...]] = {f"/{name}": (name,) for name in robots}
        both = sorted(robots, key=lambda name: robots[name].side)  # "left" comes before "right"
        if [robots[name].side for name in both] == ["left", "right"]:
            groups[f"/{cell}"] = tuple(both)
        for prefix, names in groups.items():
            for kind, field in _KINDS.items():
                for spelling in _SPELLINGS:
                    self._orders[f"{prefix}/joint_group_{kind}_controller/{spelling}"] = field, names
        self._settings = {f"/{name}/set_parameter" for name in robots}
        self._stops = {f"/{name}/stop" for name in robots}
        self.types = dict.fromkeys(self._orders, _NUMBERS)
        self.types |= dict.fromkeys(self._settings, _TEXT) | dict.fromkeys(self._stops, _EMPTY)

    def requests(self, topic: str, content: Any, client: str) -> list[Request]:
        """Return what a message asks the loop for."""
        if topic in self._stops:
            return [Stop(client)]
        if topic in self._settings:
            return [SetRequest(client, _settings(topic, content))]
        field, names = self._orders[topic]
        values = _numbers(topic, content, [self._robots[name] for name in names])
        found: list[Request] = []
        first = 0
        for name in names:
            end = first + self._robots[name].n
            request = CommandRequest(client, name, first=first)
            found.append(msgspec.structs.replace(request, **{field: values[first:end]}))
            first = end
        return found


def _numbers(topic: str, content: Any, arms: Sequence[Robot]) -> list[float]:
    count = sum(arm.n for arm in arms)
    given = content.tolist() if isinstance(content, np.ndarray) else content
    try:
        if not isinstance(given, list | tuple) or not {type(value) for value in given} <= _NUMERIC:
            raise TypeError
        values = [math.nan if value is None else float(value) for value in given]
    except (TypeError, OverflowError):
        raise CommandRefused(f"Expected {count} numbers on {topic}, got {reprlib.repr(given)}.") from None
    if len(values) != count:
        raise CommandRefused(f"Expected {count} numbers on {topic}, got {len(values)}.")
    bad = [k for k, value in enumerate(values) if not math.isfinite(value)]
    if bad:
        firsts = np.cumsum([0, *(arm.n for arm in arms)]).tolist()
        joints = [joint_name(arm, i, first) for arm, first in zip(arms, firsts, strict=False) for i in range(arm.n)]
        raise CommandRefused(f"Expected finite numbers on {topic}, got {values[bad[0]]} for {joints[bad[0]]}.")
    return values


def _settings(topic: str, content: Any) -> dict[str, Any]:
    if not isinstance(content, str) or len(content) > _LONGEST:
        raise CommandRefused(f"Expected a text of at most {_LONGEST} characters on {topic}.")
    try:
        values = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise CommandRefused(f'Expected JSON such as {{"gain": 2.0}} on {topic}, but {error}.') from None
    if not isinstance(values, dict) or not values:
        raise CommandRefused(f'Expected values by name such as {{"gain": 2.0}} on {topic}, got {content[:80]!r}.')
    return values


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

    def answer(self, client: str, text: str) -> None:
        """Answer in the diagnostics, which all nodes read: over DDS and Zenoh no other message leads back to a node."""
        self._topics.answer = f"{client}: {text}"

    def serve(self, look: Callable[[], None] = lambda: None) -> None:
        """Serve until the loop closes the feed; `look` is called at least once a second."""
        while (messages := self._loop.receive(_AGAIN)) is not None:
            for message in messages:
                self.pass_on(message)
            look()
            if time.monotonic() - self._told > _AGAIN:
                self.tell_parameters()

    def pass_on(self, message: bytes | dict[str, Any]) -> None:
        """Make of a message of the loop what nodes read."""
        if isinstance(message, bytes):
            self.send(self._topics.of_row(message, self.wanted()))
        elif message["kind"] == "parameters":
            self.tell_parameters()
        elif message["kind"] == "answer":
            self.answer(message["client"], message["text"])

    def take(self, topic: str, said: Any, client: str) -> None:
        """Pass on to the loop what a node says, bytes of a message or read already; for threads of the transport."""
        try:
            if isinstance(said, bytes):
                said = content(self._commands.types[topic], said)
            for request in self._commands.requests(topic, said, client):
                self._loop.ask(request)
        except CommandRefused as error:
            self.refuse(client, str(error))

    def refuse(self, client: str, why: str) -> None:
        """Tell a node and the log of the run why its message was not taken."""
        self.answer(client, why)
        self._loop.ask(Report(client, why))

    def left(self, client: str) -> None:
        """Tell the loop that a client has gone; called by threads of the transport."""
        self._loop.ask(Leave(client))

    def send(self, messages: Messages) -> None:
        """Send messages of `store`."""
        for topic, message in messages:
            self.write(topic, bytes(store().serialize_cdr(message, topic.type)))

    def tell_parameters(self) -> None:
        """Send the values of all parameters, and that no row comes where none does."""
        self._told, wanted = time.monotonic(), self.wanted()
        self.send(self._topics.of_parameters(self._loop.parameters, wanted))
        self.send(self._topics.of_silence(time.monotonic_ns(), wanted))
