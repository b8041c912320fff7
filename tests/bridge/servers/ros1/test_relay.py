"""The relay by itself, with a rospy that the test plays. With a master and a real one: see test_process."""

from __future__ import annotations

import ast
import json
import select
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from armlab.bridge.servers.ros1 import relay


def test_main_without_rospy_ends_with_a_sentence() -> None:
    """Under this Python, which has no rospy; `main` is run as the program it is."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        command = [sys.executable, "-I", relay.__file__]
        done = subprocess.run(command, stdin=theirs.fileno(), capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "Install python3-rospy." in done.stderr
    assert relay.main.__doc__


def test_it_needs_the_standard_library_only_and_an_old_python() -> None:
    tree = ast.parse(Path(relay.__file__).read_text(encoding="utf-8"), feature_version=(3, 6))
    names = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    names |= {str(node.module) for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert names <= sys.stdlib_module_names


class Played:
    """The node, its end of the pipe, and a rospy in which messages come as soon as there is a subscriber."""

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
        """Return the end of a node that has come."""
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
    made = Played(monkeypatch)
    yield made
    made.close()


def test_ready_is_said_before_the_first_command(played: Played) -> None:
    ready, command = played.first
    assert ready == {"kind": "ready", "missing": ["a/B"]}
    assert command == {"kind": "command", "topic": "/orders", "client": "/node", "content": "first"}


@pytest.mark.parametrize("count", [8_000, 100_000])
def test_a_long_message_becomes_a_refusal_that_tells_its_size(played: Played, count: int) -> None:
    """Of 160 kB, which is more than the bridge reads at once; and of more than the pipe takes."""
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
