"""Connections of nodes: what they read, in order and whole; who is slow or has gone holds nobody up."""

from __future__ import annotations

import select
import socket
import struct
from collections.abc import Iterator

import pytest

from armlab.bridge.servers.ros.topics import Topic
from armlab.bridge.servers.ros1.process import Subscribers

STATES = Topic("/arm/joint_states", "sensor_msgs/msg/JointState")
TEXTS = Topic("/arm/parameters", "std_msgs/msg/String")
PATIENCE = 20.0  # s; only a test that fails waits so long


class Nodes:
    """Subscribers at one end, sockets of nodes at the other."""

    def __init__(self) -> None:
        self.looks = select.poll()
        self.subscribers = Subscribers(self.looks)
        self.ends: list[socket.socket] = []

    def node(self, topic: Topic, *known: bytes) -> socket.socket:
        """Return the end of a node that reads a topic; the other end is ours, and rospy's as well."""
        with socket.create_server(("127.0.0.1", 0)) as server:
            theirs = socket.create_connection(server.getsockname())
            ours, _ = server.accept()
        theirs.settimeout(PATIENCE)
        self.ends += [theirs, ours.dup()]
        self.subscribers.add(topic.name, ours, known)
        return theirs

    def look(self) -> None:
        """Look at what is to be seen within a time that is enough on this computer."""
        for number, _ in self.looks.poll(1000.0):
            self.subscribers.look(number)

    def close(self) -> None:
        self.subscribers.close()
        for one in self.ends:
            one.close()


@pytest.fixture
def nodes() -> Iterator[Nodes]:
    made = Nodes()
    yield made
    made.close()


def read(node: socket.socket, nodes: Nodes) -> bytes:
    """Return one message; what waits for room is sent meanwhile."""

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
        assert sent < 20_000, "all of it vanished in buffers"
    found: list[int] = []
    while not found or found[-1] < sent:
        message = read(slow, nodes)
        assert message[4:] == bytes(9_996)
        found += struct.unpack_from("<I", message)
    assert found == sorted(set(found)), "in order, and none twice"
    assert found[-500:] == [*range(sent - 500 + 1, sent + 1)]
    assert len(found) == sent - lost
    kept = sent - lost - 500
    assert found[: kept // 2] == [*range(1, kept // 2 + 1)], "room that the system made later lets others pass"
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


def test_the_first_is_dropped_after_500_and_what_the_buffers_of_the_system_hold(nodes: Nodes) -> None:
    nodes.node(STATES)
    sent = 0
    while nodes.subscribers.counts.get(STATES.name, (0, 0))[1] == 0:
        sent += 1
        nodes.subscribers.send(STATES, bytes(400))
        assert sent < 2000, "8 s of joint states"
    assert sent > 500


def test_what_waited_for_a_node_that_ends_is_lost(nodes: Nodes) -> None:
    nodes.node(STATES)
    for _ in range(400):
        nodes.subscribers.send(STATES, bytes(10_000))
    assert nodes.subscribers.counts == {STATES.name: (400, 0)}
    nodes.subscribers.close()
    sent, lost = nodes.subscribers.counts[STATES.name]
    assert sent + lost == 400
    assert lost > 200


def test_beyond_64_connections_a_node_is_ended_and_the_reason_told(nodes: Nodes) -> None:
    first, *_ = [nodes.node(STATES) for _ in range(64)]
    assert nodes.node(TEXTS).recv(1) == b""
    assert nodes.subscribers.wanted == {STATES.name}
    surplus, other = socket.socketpair()
    with other:
        assert "Expected at most 64 connections" in nodes.subscribers.add(TEXTS.name, surplus)
    first.close()
    nodes.look()
    nodes.node(TEXTS)
    assert nodes.subscribers.wanted == {STATES.name, TEXTS.name}


def test_in_the_end_nodes_see_that_it_is_over(nodes: Nodes) -> None:
    node = nodes.node(STATES)
    nodes.subscribers.close()
    assert node.recv(1) == b"", "the socket that rospy holds too"
    assert nodes.subscribers.wanted == frozenset()


def test_a_node_that_is_cut_off_while_it_is_written_to_is_let_go(nodes: Nodes) -> None:
    gone = nodes.node(STATES)
    gone.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    gone.close()
    sent = 0
    while nodes.subscribers.wanted and sent < 1000:  # the system may tell later
        nodes.subscribers.send(STATES, bytes(8))
        sent += 1
        nodes.looks.poll(20.0)
    assert nodes.subscribers.wanted == frozenset()
    assert nodes.subscribers.counts == {STATES.name: (sent - 1, 1)}
