"""`Commands`, which handles commands from ROS nodes, and `RosServer`, the base class of all ROS servers."""

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
from armlab.bridge.servers.ros.actions import ActionServers, Goals, plain
from armlab.bridge.servers.ros.services import Service, Settings, parameter_services
from armlab.bridge.servers.ros.topics import Messages, RosTopic, Topics, content, store
from armlab.bridge.servers.server_end import Clients, LoopEnd
from armlab.errors import CommandRefused
from armlab.robots import Robot

_KINDS = {"position": "q", "velocity": "qd", "effort": "tau"}
_SPELLINGS = ("command", "commands")  # in ROS 1 and ROS 2
_NUMBERS, _TEXT, _EMPTY = "std_msgs/msg/Float64MultiArray", "std_msgs/msg/String", "std_msgs/msg/Empty"
_LONGEST = 65536  # maximum text length in characters
_NUMERIC = {int, float, type(None)}  # excludes bool, a subclass of int; null stands for a non-finite number


class Commands:
    """Command topics with their types; converts their messages to requests."""

    types: dict[str, str]

    def __init__(self, cell: str, robots: Mapping[str, Robot]) -> None:
        self._robots = dict(robots)
        self._orders: dict[str, tuple[str, tuple[str, ...]]] = {}
        groups: dict[str, tuple[str, ...]] = {f"/{name}": (name,) for name in robots}
        both = sorted(robots, key=lambda name: robots[name].side)  # sorts "left" before "right"
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
        """Convert a message to requests for the loop."""
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
        raise CommandRefused(f"Expected text of at most {_LONGEST} characters on {topic}.")
    try:
        values = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise CommandRefused(f'Expected JSON such as {{"gain": 2.0}} on {topic}, got {error}.') from None
    if not isinstance(values, dict) or not values:
        raise CommandRefused(f'Expected named values such as {{"gain": 2.0}} on {topic}, got {content[:80]!r}.')
    return values


_AGAIN = 1.0  # s between publications of the parameters, so that new readers receive them


class RosServer:
    """Base class of the ROS servers; a subclass adds the transport by defining `write` and `wanted`."""

    def __init__(self, feed: socket.socket, clients: Callable[[], Clients], tf: bool = False) -> None:
        self._loop = LoopEnd(feed, clients)
        robots = self._loop.robots()
        cell = self._loop.about["cell"]
        self._topics, self._commands = Topics(robots, self._loop.schema, tf), Commands(cell, robots)
        self._parameters_sent = 0.0
        self.nodes: tuple[str, ...] = tuple(dict.fromkeys(name.replace("-", "_") for name in (cell, *robots)))
        self._settings = Settings(self._loop)
        self.services: list[Service] = [
            one for name in robots for one in parameter_services(name, self._loop, self._settings)
        ]
        self._goals = Goals(self._loop)
        actions = ActionServers(self._goals, lambda topic, message: self.send([(topic, message)]), self.wanted)
        self.services += actions.services
        self.published: dict[str, RosTopic] = self._topics.published | actions.topics
        self.latched: frozenset[str] = frozenset([*self._topics.latched, *actions.latched])

    def node_of(self, name: str) -> str:
        """Return the node of a topic or service: the arm's node if the name contains an arm, otherwise the cell's
        node."""
        first = name.split("/")[1]
        return first if first in self.nodes else self.nodes[0]

    def wanted(self) -> frozenset[str]:
        """Return the names of the topics with readers."""
        raise NotImplementedError

    def write(self, topic: RosTopic, cdr: bytes) -> None:
        """Send one message."""
        raise NotImplementedError

    def answer(self, client: str, text: str) -> None:
        """Publish an answer in the diagnostics, because DDS and Zenoh cannot reply to a single node."""
        self._topics.answer = f"{client}: {text}"

    def serve(self, check: Callable[[], None] = lambda: None) -> None:
        """Serve until the loop closes the socket; call `check` at least once a second."""
        while (messages := self._loop.receive(_AGAIN)) is not None:
            for message in messages:
                self.publish(message)
            check()
            now_ns = time.monotonic_ns()
            self._settings.tick(now_ns)
            self._goals.renew(now_ns)
            if time.monotonic() - self._parameters_sent > _AGAIN:
                self.send_parameters()

    def publish(self, message: bytes | dict[str, Any]) -> None:
        """Publish a message from the loop to the nodes."""
        if isinstance(message, bytes):
            self.send(self._topics.of_row(message, self.wanted()))
            self._goals.row(message, time.monotonic_ns())
        elif message["kind"] == "parameters":
            self._settings.confirm()
            self.send_parameters()
        elif message["kind"] == "answer" and not self._settings.refuse(message):
            self.answer(message["client"], message["text"])
        elif message["kind"] == "goal":
            self._goals.text(message)

    def take(self, topic: str, message: Any, client: str) -> None:
        """Send the requests in a node's message (serialised or decoded) to the loop; called from transport threads."""
        try:
            if topic in self._goals.topics:
                message = plain(content(self._goals.topics[topic], message))
                self._goals.start_message(topic, client, message, lambda why: self.answer(client, why))
                return
            if isinstance(message, bytes):
                message = content(self._commands.types[topic], message)
            for request in self._commands.requests(topic, message, client):
                self._loop.ask(request)
        except CommandRefused as error:
            self.refuse(client, str(error))

    def request(self, service: Service, cdr: bytes, client: str, send: Callable[[bytes], None]) -> None:
        """Answer a node's serialised request; called from transport threads."""
        try:
            service.take(cdr, client, send)
        except CommandRefused as error:
            self.refuse(client, str(error))

    def refuse(self, client: str, why: str) -> None:
        """Report a refused message to its node and to the log of the run."""
        self.answer(client, why)
        self._loop.ask(Report(client, why))

    def left(self, client: str) -> None:
        """Report a disconnected client to the loop; called from transport threads."""
        self._goals.leave(client)
        self._loop.ask(Leave(client))

    def left_service(self, client: str) -> None:
        """Report a disconnected service client if it has started a trajectory."""
        if self._goals.running(client=client):
            self.left(client)

    def send(self, messages: Messages) -> None:
        """Serialise and write messages of `store`."""
        for topic, message in messages:
            self.write(topic, bytes(store().serialize_cdr(message, topic.type)))

    def send_latched(self) -> None:
        """Send the constant messages once; their writers keep them for late-joining readers."""
        self.send(self._topics.latched.values())

    def send_parameters(self) -> None:
        """Send all parameter values, and any diagnostics that are due while no rows arrive."""
        self._parameters_sent, wanted = time.monotonic(), self.wanted()
        self.send(self._topics.of_parameters(self._loop.parameters, wanted))
        self.send(self._topics.of_silence(time.monotonic_ns(), wanted))
