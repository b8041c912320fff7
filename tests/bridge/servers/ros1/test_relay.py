"""The relay alone with a simulated rospy, and the connections of nodes; test_process.py uses real nodes."""

from __future__ import annotations

import ast
import contextlib
import json
import select
import socket
import struct
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from armlab.bridge.servers.ros.topics import RosTopic
from armlab.bridge.servers.ros1 import relay
from armlab.bridge.servers.ros1.process import Subscribers


def test_main_without_rospy_ends_with_a_sentence() -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        command = [sys.executable, "-I", relay.__file__]
        done = subprocess.run(command, stdin=theirs.fileno(), capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "Install python3-rospy." in done.stderr


def test_it_needs_the_standard_library_only_and_an_old_python() -> None:
    tree = ast.parse(Path(relay.__file__).read_text(encoding="utf-8"), feature_version=(3, 6))
    names = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    names |= {str(node.module) for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert names <= sys.stdlib_module_names


class Played:
    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(relay, "_type", {"std_msgs/String": str}.get)
        self.logged: list[str] = []
        ours, self.bridge = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.bridge.settimeout(20.0)
        rospy = SimpleNamespace(
            Publisher=self.publisher, Subscriber=self.subscriber, SubscribeListener=object, logwarn=self.logged.append
        )
        about = {"published": {"/states": "std_msgs/String"}, "taken": {"/orders": "std_msgs/String", "/more": "a/B"}}
        self.node = relay._Node(rospy, ours, about)
        self.first = [self.said(), self.said()]
        self.states = self.node._publishers["/states"]

    def publisher(self, topic: str, kind: type, queue_size: int) -> SimpleNamespace:
        listen = SimpleNamespace(connections=[], add_subscriber_listener=lambda listener: None)
        return SimpleNamespace(resolved_name=topic, impl=listen)

    def subscriber(self, topic: str, kind: type, take: Any, *arguments: Any, **options: Any) -> None:
        take(self.message("first"), topic)

    def message(self, data: Any) -> SimpleNamespace:
        return SimpleNamespace(data=data, _connection_header={"callerid": "/node"})

    def connection(self, number: int) -> socket.socket:
        ours, theirs = socket.socketpair()
        theirs.settimeout(20.0)
        self.states.impl.connections.append(SimpleNamespace(id=number, endpoint_id="/node", socket=ours))
        return theirs

    def said(self) -> dict[str, Any]:
        return json.loads(self.bridge.recv(2**20))

    def close(self) -> None:
        for one in (self.bridge, self.node._pipe, *(one.socket for one in self.states.impl.connections)):
            one.close()


@pytest.fixture
def played(monkeypatch: pytest.MonkeyPatch) -> Iterator[Played]:
    with contextlib.closing(Played(monkeypatch)) as made:
        yield made


def test_ready_is_said_before_the_first_command(played: Played) -> None:
    ready, command = played.first
    assert ready == {"kind": "ready", "missing": ["a/B"]}
    assert command == {"kind": "command", "topic": "/orders", "client": "/node", "content": "first"}


@pytest.mark.parametrize("count", [8_000, 100_000])
def test_a_long_message_becomes_a_refusal_that_tells_its_size(played: Played, count: int) -> None:
    played.node._take(played.message([0.12345678901234567] * count), "/orders")
    said = played.said()
    assert (said["kind"], said["client"]) == ("refused", "/node")
    assert "Expected at most 65536 bytes of JSON on /orders, got " in said["text"]
    played.node._take(played.message("x" * 65_000), "/orders")
    assert len(played.said()["content"]) == 65_000


def test_a_message_for_a_bridge_that_has_gone_vanishes(played: Played) -> None:
    played.bridge.close()
    played.node._take(played.message("text"), "/orders")


def test_a_connection_that_cannot_be_handed_over_is_ended(played: Played) -> None:
    pipe = played.node._pipe
    with played.connection(3) as reader:
        played.node._pipe, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        other.close()
        played.node._hand_over(played.states)
        played.node._pipe.close()
        assert reader.recv(1) == b""
    played.node._pipe = pipe
    for _ in range(2):
        played.node._hand_over(played.states)
    assert played.said() == {"kind": "subscriber", "topic": "/states", "client": "/node", "id": 3}
    assert not select.select([played.bridge], [], [], 0.0)[0], "once is enough"


def test_run_writes_sentences_into_the_log_and_ends_connections(played: Played) -> None:
    with played.connection(3) as stays, played.connection(4) as ends:
        played.bridge.send(json.dumps({"text": "100 % no"}).encode())
        played.bridge.send(json.dumps({"topic": "/states", "id": 4}).encode())
        played.bridge.shutdown(socket.SHUT_WR)
        played.node.run()
        assert played.logged == ["100 % no"]
        assert ends.recv(1) == b""
        assert not select.select([stays], [], [], 0.0)[0]


STATES = RosTopic("/arm/joint_states", "sensor_msgs/msg/JointState")
TEXTS = RosTopic("/arm/parameters", "std_msgs/msg/String")
PATIENCE = 20.0  # s; only a test that fails waits so long


class Nodes:
    def __init__(self) -> None:
        self.looks = select.poll()
        self.subscribers = Subscribers(self.looks)
        self.ends: list[socket.socket] = []

    def node(self, topic: RosTopic, *known: bytes) -> socket.socket:
        with socket.create_server(("127.0.0.1", 0)) as server:
            theirs = socket.create_connection(server.getsockname())
            ours, _ = server.accept()
        theirs.settimeout(PATIENCE)
        self.ends += [theirs, ours.dup()]
        self.subscribers.add(topic.name, ours, known)
        return theirs

    def look(self) -> None:
        for number, _ in self.looks.poll(1000.0):
            self.subscribers.check(number)

    def close(self) -> None:
        self.subscribers.close()
        for one in self.ends:
            one.close()


@pytest.fixture
def nodes() -> Iterator[Nodes]:
    with contextlib.closing(Nodes()) as made:
        yield made


def read(node: socket.socket, nodes: Nodes) -> bytes:
    def exactly(count: int) -> bytes:
        data = b""
        for _ in range(1000):
            if len(data) == count:
                break
            if not select.select([node], [], [], 0.0)[0]:
                nodes.look()
            data += node.recv(count - len(data))
        return data

    return exactly(struct.unpack("<I", exactly(4))[0])


def test_messages_go_to_those_who_read_their_topic_and_are_counted(nodes: Nodes) -> None:
    first, texts = nodes.node(STATES), nodes.node(TEXTS, b"before")
    nodes.subscribers.send(STATES, bytes(4) + b"a")
    second = nodes.node(STATES)
    nodes.subscribers.send(STATES, bytes(4) + b"b")
    nodes.subscribers.send(TEXTS, b"text")
    assert [read(first, nodes), read(first, nodes)] == [b"\1\0\0\0a", b"\2\0\0\0b"]
    assert read(second, nodes) == b"\2\0\0\0b"
    assert [read(texts, nodes), read(texts, nodes)] == [b"before", b"text"]
    assert nodes.subscribers.wanted == {STATES.name, TEXTS.name}
    assert nodes.subscribers.counts == {STATES.name: (3, 0), TEXTS.name: (2, 0)}


def test_a_node_that_does_not_read_loses_the_oldest_and_holds_nobody_up(nodes: Nodes) -> None:
    slow, quick = nodes.node(STATES), nodes.node(STATES)
    sent, (_, lost) = 0, (0, 0)
    while lost < 100:
        sent += 1
        nodes.subscribers.send(STATES, bytes(10_000))
        assert struct.unpack_from("<I", read(quick, nodes)) == (sent,)
        _, lost = nodes.subscribers.counts[STATES.name]
        assert sent < 20_000, "all messages vanished in buffers"
    found: list[int] = []
    while not found or found[-1] < sent:
        message = read(slow, nodes)
        assert message[4:] == bytes(9_996)
        found += struct.unpack_from("<I", message)
    assert found == sorted(set(found)), "in order, without duplicates"
    assert found[-500:] == [*range(sent - 500 + 1, sent + 1)]
    assert len(found) == sent - lost
    kept = sent - lost - 500
    assert found[: kept // 2] == [*range(1, kept // 2 + 1)], "space freed later lets further messages pass"
    assert nodes.looks.poll(0.0) == [], "there is room, and nothing waits"


def test_a_node_that_has_gone_is_let_go(nodes: Nodes) -> None:
    gone, stays = nodes.node(STATES), nodes.node(TEXTS)
    gone.close()
    nodes.look()
    assert nodes.subscribers.wanted == {TEXTS.name}
    assert nodes.looks.poll(0.0) == []
    nodes.ends[3].shutdown(socket.SHUT_RDWR)  # as rospy does when it ends a connection
    nodes.look()
    assert nodes.subscribers.wanted == frozenset()
    assert stays.recv(1) == b""


def test_a_node_that_is_cut_off_while_it_is_written_to_is_let_go(nodes: Nodes) -> None:
    gone = nodes.node(STATES)
    gone.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    gone.close()
    sent = 0
    while nodes.subscribers.wanted and sent < 1000:  # the system may report the end later
        nodes.subscribers.send(STATES, bytes(8))
        sent += 1
        nodes.looks.poll(20.0)
    assert nodes.subscribers.wanted == frozenset()
    assert nodes.subscribers.counts == {STATES.name: (sent - 1, 1)}
