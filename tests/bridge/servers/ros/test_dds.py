"""The server of ROS 2 over DDS at the other end of a hub; a participant of the same process plays the nodes."""

from __future__ import annotations

import logging
import os
import socket
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

from armlab import robots
from armlab.bridge.inputs.parameters import Parameter
from armlab.bridge.servers.ros import dds
from armlab.bridge.servers.ros.dds import (
    DataReader,
    DdsServer,
    Readers,
    Writers,
    carrier,
    configuration,
    joined,
    struct,
    tie_to_loopback,
    topic_name,
)
from armlab.bridge.servers.ros.server import Commands
from armlab.bridge.servers.ros.topics import RosTopic, Topics, store, type_name
from armlab.bridge.servers.row import RowSchema
from armlab.errors import LinkError

from ..conftest import WALL, Served, until
from .dds_peers import Node, free_domain, numbers, taken, write

pytest.importorskip("cyclonedds", reason="the extra ros is not installed")
ARM = robots.load("yumi_left")
JOINTS, ARRAY, TEXT = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64MultiArray", "std_msgs/msg/String"


VELOCITY = "/yumi_left/joint_group_velocity_controller/commands"


class Running(Served):
    """The server's work in a thread, and a node: a participant, so one client."""

    def __init__(self, rights: Literal["anyone", "commander"] = "anyone", **options: Any) -> None:
        self.domain, gain = free_domain(), Parameter("gain", 0.5, minimum=0.0, maximum=1.0, rights=rights)
        own = {"domain": self.domain, "host": "127.0.0.1"}
        super().__init__("ros2", ARM, lambda feed: DdsServer(feed, own), [gain], **options)
        self.node = Node(self.domain)

    def close(self) -> None:
        del self.node
        super().close()


@pytest.fixture(autouse=True)
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    """Parameters and diagnostics come ten times a second, an arm is silent after a fifth of one."""
    monkeypatch.setattr("armlab.bridge.servers.ros.server._AGAIN", 0.1)
    monkeypatch.setattr("armlab.bridge.servers.ros.topics._PERIOD_NS", 10**8)
    monkeypatch.setattr("armlab.bridge.servers.ros.topics._SILENT", 0.2)


@pytest.fixture
def running() -> Iterator[Running]:
    one = Running()
    yield one
    one.close()


def client(writer: Any) -> str:
    return writer.guid.hex[:24]


def answer(running: Running, diagnostics: Any) -> str:
    """What the newest diagnostics say to clients, "" while none has come."""
    running.tick += 250  # a second later
    running.commanded()
    found = taken(diagnostics, "diagnostic_msgs/msg/DiagnosticArray")
    values = {one.key: one.value for message in found for one in message.status[0].values}
    return values.get("last answer", "none").replace("none", "")


def test_rows_become_messages_of_what_is_read(running: Running) -> None:
    assert running.where == [f"127.0.0.1 (ros2, DDS domain {running.domain})"]
    readers = [running.node.reader("/yumi_left/joint_states", JOINTS)]
    found: list[Any] = []

    def came() -> bool:
        running.row(q=ARM.q_home + 1e-3 * running.tick)
        found.extend(taken(readers[0], JOINTS))
        return len(found) >= 10

    until(came)
    for message in found:
        k = (message.header.stamp.sec * 10**9 + message.header.stamp.nanosec - WALL) // 4_000_000
        assert np.array_equal(message.position, ARM.q_home + 1e-3 * k)
        assert (len(message.velocity), len(message.effort)) == (7, 0)
    counts = running.exchange.summary()["servers"]["ros2"]["clients"]
    assert list(counts) == ["/yumi_left/joint_states"]
    written, full = counts["/yumi_left/joint_states"]
    assert len(found) <= written <= running.tick
    assert full == 0
    readers.clear()
    until(lambda: running.commanded() is None and running.server.wanted() == frozenset(), what="nobody reading")


def test_commands_take_the_arm_until_the_writer_leaves(running: Running) -> None:
    writers = {"velocity": running.node.writer(VELOCITY, ARRAY)}
    qd = np.arange(7) / 100.0

    def obeyed() -> bool:
        write(writers["velocity"], ARRAY, *numbers(*qd))
        command = running.commanded()
        return command is not None and command.qd is not None and np.array_equal(command.qd, qd)

    until(obeyed)
    who = running.exchange.arbiter.commander("yumi_left")
    assert who == f"ros2 {client(writers['velocity'])}"
    events: list[str] = []
    running.exchange.begin(lambda text, *_: events.append(text))
    running.exchange.arbiter._lease_ns = 10**12  # what ends it is that the writer leaves
    writers.clear()
    until(
        lambda: (
            running.commanded() is None and f"{who} no longer commands yumi_left: it closed. The arm holds." in events
        )
    )


def test_a_second_commander_is_refused_by_a_sentence(running: Running) -> None:
    first = running.node.writer(VELOCITY, ARRAY)
    until(lambda: write(first, ARRAY, *numbers(*[0.01] * 7)) or running.commanded())
    other = Node(running.domain)
    second = other.writer("/yumi_left/joint_group_position_controller/command", ARRAY)
    diagnostics = running.node.reader("/yumi_left/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")

    def told() -> str:
        write(first, ARRAY, *numbers(*[0.01] * 7))
        write(second, ARRAY, *numbers(*ARM.q_home))
        return answer(running, diagnostics)

    said = f"{client(second)}: yumi_left is commanded by ros2 {client(first)}. You may read."
    assert until(told).startswith(said)


def test_who_commands_with_one_topic_sets_parameters_and_commands_with_another() -> None:
    running = Running(rights="commander")
    velocity = running.node.writer(VELOCITY, ARRAY)
    writers = [running.node.writer("/yumi_left/joint_group_position_controller/command", ARRAY)]
    setter = running.node.writer("/yumi_left/set_parameter", TEXT)

    def is_set() -> bool:
        write(velocity, ARRAY, *numbers(*[0.01] * 7))
        write(setter, TEXT, '{"gain": 0.75}')
        running.commanded()
        return running.exchange.parameters.gain == 0.75 and running.exchange.arbiter.commander(ARM.name) != ""

    def moves() -> bool:
        write(writers[0], ARRAY, *numbers(*ARM.q_home))
        command = running.commanded()
        return command is not None and command.q is not None

    until(is_set)
    running.exchange.arbiter._lease_ns = 10**12  # silence frees nothing
    until(moves)
    writers.clear()
    assert (
        until(lambda: running.commanded() and running.exchange.arbiter.commander(ARM.name))
        == f"ros2 {client(velocity)}"
    )
    running.close()


def test_diagnostics_come_and_say_so_when_no_row_comes(running: Running) -> None:
    diagnostics = running.node.reader("/yumi_left/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
    found: list[Any] = []

    def words() -> str:
        found.extend(taken(diagnostics, "diagnostic_msgs/msg/DiagnosticArray"))
        return found[-1].status[0].message if found else ""

    until(lambda: words() == "no packet yet")
    running.commanded()
    until(lambda: "no packet for" in words())
    assert found[-1].status[0].level == 2


def test_parameters_are_set_and_told_again_to_who_comes_later_and_the_arms_are_stopped(running: Running) -> None:
    writer = running.node.writer("/yumi_left/set_parameter", TEXT)
    until(
        lambda: write(writer, TEXT, '{"gain": 0.75}') or running.commanded() or running.exchange.parameters.gain == 0.75
    )
    reader = running.node.reader("/yumi_left/parameters", TEXT)
    found: list[Any] = []
    until(lambda: found.extend(taken(reader, TEXT)) or found)
    assert found[-1].data == '{"gain": 0.75}'
    stop = running.node.writer("/yumi_left/stop", "std_msgs/msg/Empty")
    until(lambda: write(stop, "std_msgs/msg/Empty") or running.commanded() or running.exchange.arbiter.stopped)
    assert running.exchange.arbiter.stopped == f"ros2 {client(stop)}", "any node may"


def text(words: str) -> bytes:
    """A message of any number of bytes, also such that are no multiple of 4."""
    return bytes(store().serialize_cdr(store().types[TEXT](words), TEXT))


@pytest.fixture
def node() -> Iterator[Node]:
    domain = free_domain()
    with joined(domain, "127.0.0.1"):
        yield Node(domain)


def test_a_topic_is_wanted_while_it_has_a_reader(node: Node) -> None:
    topics = {name: RosTopic(name, TEXT) for name in ("/a", "/b")}
    writers = Writers(node.participant, topics)
    assert writers.wanted == frozenset()
    readers = [node.reader("/b", TEXT), node.reader("/b", TEXT)]
    until(lambda: writers.wanted == {"/b"})
    for k in range(3):
        writers.write(topics["/b"], text(f"text {k}"))
    assert writers.counts == {"/b": (3, 0)}
    for texts in [[message.data for message in taken(reader, TEXT)] for reader in readers]:
        assert texts == ["text 0", "text 1", "text 2"]
    readers.pop()
    assert writers.wanted == {"/b"}
    readers.clear()
    until(lambda: writers.wanted == frozenset())
    last = node.reader("/a", TEXT)
    until(last.get_matched_publications)
    writers.close()
    until(lambda: not last.get_matched_publications())


def test_of_what_a_reader_has_not_read_the_last_ten_are_kept(node: Node) -> None:
    topic = RosTopic("/a", TEXT)
    writers = Writers(node.participant, {"/a": topic})
    reader = node.reader("/a", TEXT)
    for k in range(500):
        writers.write(topic, text(str(k)))
    assert writers.counts == {"/a": (500, 0)}, "nothing waited"
    assert [message.data for message in taken(reader, TEXT)] == [str(k) for k in range(490, 500)]


def test_messages_come_with_their_writer_and_its_end_is_told(node: Node) -> None:
    came: list[tuple[str, bytes, str]] = []
    left: list[str] = []
    readers = Readers(node.participant, {"/a": TEXT, "/b": ARRAY}, lambda *one: came.append(one), left.append)
    writers = [node.writer("/a", TEXT), node.writer("/b", ARRAY), node.writer("/b", TEXT)]
    client = writers[0].guid.hex[:24]  # of the participant
    other = Node(node.domain)
    last = other.writer("/a", TEXT)
    write(writers[0], TEXT, "hello")
    until(lambda: len(came) == 1)
    write(writers[2], TEXT, "another type on the same topic is another topic")
    write(writers[1], ARRAY, *numbers(1.0, 2.0))
    until(lambda: len(came) == 2)
    assert [(name, client) for name, _, client in came] == [("/a", client), ("/b", client)]
    assert store().deserialize_cdr(came[0][1], TEXT).data == "hello"
    assert store().deserialize_cdr(came[1][1], ARRAY).data.tolist() == [1.0, 2.0]
    until(lambda: len(readers._clients) == 3)
    del writers[0]
    until(lambda: len(readers._clients) == 2)
    assert left == [], "it has another writer"
    writers.clear()  # it is told with a sample that holds no message, which is none
    until(lambda: left)
    assert left == [client]
    assert len(came) == 2
    del last
    until(lambda: len(left) == 2)
    assert left[1] == other.participant.guid.hex[:24] != client
    writer = node.writer("/a", TEXT)
    until(writer.get_matched_subscriptions)
    readers.close()
    until(lambda: not writer.get_matched_subscriptions())


def test_writers_may_be_there_first(node: Node, caplog: pytest.LogCaptureFixture) -> None:
    """DDS tells of them before the reader is an object in Python."""
    came: list[tuple[str, bytes, str]] = []
    left: list[str] = []
    writer, other = node.writer("/a", TEXT), node.writer("/a", TEXT)
    with caplog.at_level(logging.ERROR, "armlab.bridge"):
        readers = Readers(node.participant, {"/a": TEXT}, lambda *one: came.append(one), left.append)
        until(writer.get_matched_subscriptions)
        write(writer, TEXT, "hello")
        until(lambda: came)
        del writer
        until(lambda: len(readers._clients) == 1)
        assert left == [], "it has another writer, which has not written yet"
        del other
        until(lambda: left)
        readers.close()
    assert caplog.text == ""


@pytest.mark.parametrize("ends", [False, True])
def test_what_comes_while_a_reader_is_made_is_read(node: Node, monkeypatch: pytest.MonkeyPatch, ends: bool) -> None:
    """DDS calls for it in vain then, and would not call again before the next message; nor tell that a writer ended."""
    came: list[str] = []
    left: list[str] = []
    writers = [node.writer("/a", TEXT)]

    def made(*arguments: Any) -> DataReader[Any]:
        reader = DataReader(*arguments[:-1])  # as if its listener had been called already
        until(writers[0].get_matched_subscriptions)
        write(writers[0], TEXT, "hello")
        until(lambda: reader.read(1))
        if ends:
            writers.clear()
            until(lambda: not reader.get_matched_publications())
        return reader

    monkeypatch.setattr(dds, "DataReader", made)
    readers = Readers(node.participant, {"/a": TEXT}, lambda _name, _cdr, client: came.append(client), left.append)
    assert len(came) == 1
    assert left == (came if ends else [])
    readers.close()


def test_what_fails_is_told_and_the_next_message_comes(node: Node, caplog: pytest.LogCaptureFixture) -> None:
    came: list[str] = []

    def take(name: str, cdr: bytes, client: str) -> None:
        came.append(client)
        raise ValueError("of the test")

    readers = Readers(node.participant, {"/a": TEXT}, take, came.append)
    writer = node.writer("/a", TEXT)
    with caplog.at_level(logging.ERROR, "armlab.bridge"):
        for k in range(2):
            write(writer, TEXT, "hello")
            until(lambda k=k: len(came) > k)
    until(lambda: caplog.text.count("ValueError: of the test") == 2)
    readers.close()


PUBLISHED = {one.type for one in Topics({ARM.name: ARM}, RowSchema.of([ARM])).published.values()}
TAKEN = set(Commands("cell", {ARM.name: ARM}).types.values())
BYTES = bytes.fromhex(  # JointState of 1.000000002 s, frame "f", joints a and b, by hand
    "00010000 01000000 02000000 02000000 66000000 02000000 02000000 61000000 02000000 62000000 02000000"
    "0000000000000000 000000000000f03f 00000000 02000000 000000000000f03f 0000000000000040"
)


def test_names() -> None:
    assert topic_name("/yumi_left/joint_states") == "rt/yumi_left/joint_states"
    assert type_name("sensor_msgs/msg/JointState") == "sensor_msgs::msg::dds_::JointState_"
    for name in PUBLISHED | TAKEN:
        assert carrier(name).__idl_typename__ == struct(name).__idl_typename__ == type_name(name)


def test_golden_bytes() -> None:
    types = store().types
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](1, 2), "f")
    joints = types["sensor_msgs/msg/JointState"](
        header, ["a", "b"], np.array([0.0, 1.0]), np.zeros(0), np.array([1.0, 2.0])
    )
    assert bytes(store().serialize_cdr(joints, "sensor_msgs/msg/JointState")) == BYTES
    assert carrier("sensor_msgs/msg/JointState")(BYTES).serialize() == BYTES
    assert carrier("sensor_msgs/msg/JointState").deserialize(BYTES).cdr == BYTES


def device(one: socket.socket) -> bytes:
    return one.getsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, 16).rstrip(b"\0")


def test_settings_of_this_computer_and_of_a_network() -> None:
    local = ElementTree.fromstring(configuration("127.0.0.1"))
    interface = local.find(".//NetworkInterface")
    assert interface is not None
    assert interface.attrib == {"address": "127.0.0.1", "multicast": "false"}
    assert local.findtext(".//AllowMulticast") == "false"
    assert local.find(".//Peer[@address='127.0.0.1']") is not None
    assert local.findtext(".//InitialLocatorPruneDelay") == "inf", "nodes may start at any time"
    lab = ElementTree.fromstring(configuration("192.168.1.5"))
    interface = lab.find(".//NetworkInterface")
    assert interface is not None
    assert interface.attrib == {"address": "192.168.1.5"}
    assert lab.findtext(".//AllowMulticast") == "spdp"
    assert lab.find(".//Peer") is None
    assert lab.find(".//InitialLocatorPruneDelay") is None


def test_sockets_open_to_all_are_tied_to_this_computer(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wide, socket.create_server(("127.0.0.1", 0)) as narrow:
        wide.bind(("0.0.0.0", 0))
        assert tie_to_loopback() >= 1
        assert device(wide) == b"lo"
        assert device(narrow) == b""
        monkeypatch.setattr(dds, "_LOOPBACK", b"nowhere")
        with pytest.raises(LinkError, match="use rosbridge or Zenoh"):
            tie_to_loopback()


def test_a_participant_listens_on_this_computer_only() -> None:
    """Cyclone DDS binds to all addresses; every such socket is tied to the loopback interface."""
    domain, found = free_domain(), {}
    with joined(domain, "127.0.0.1"):
        for entry in filter(Path.is_socket, Path("/proc/self/fd").iterdir()):
            with socket.socket(fileno=os.dup(int(entry.name))) as one:
                if one.family == socket.AF_INET:
                    found[one.getsockname()[1]] = one.getsockname()[0].startswith("127.") or device(one) == b"lo"
    assert {7410 + 250 * domain, 7411 + 250 * domain} <= set(found)
    assert all(found.values())


def test_an_interface_that_is_not_there() -> None:
    with (
        pytest.raises(LinkError, match=r"on 192\.0\.2\.1, but .* Give the address"),
        joined(free_domain(), "192.0.2.1"),
    ):
        pass
