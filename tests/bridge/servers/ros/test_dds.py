"""DDS readers and writers as called by DDS threads, bytes on the wire, and excluded participants."""

from __future__ import annotations

import logging
import os
import socket
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.bridge.servers.ros import dds
from armlab.bridge.servers.ros.dds import (
    DataReader,
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

from ..conftest import until
from .dds_peers import Node, free_domain, taken

pytest.importorskip("cyclonedds", reason="the extra ros is not installed")
ARM = robots.load("yumi_left")
TEXT = "std_msgs/msg/String"


def text(words: str) -> bytes:
    return bytes(store().serialize_cdr(store().types[TEXT](words), TEXT))


@pytest.fixture
def node() -> Iterator[Node]:
    domain = free_domain()
    with joined(domain, "127.0.0.1"):
        yield Node(domain)


def test_of_what_a_reader_has_not_read_the_last_ten_are_kept(node: Node) -> None:
    topic = RosTopic("/a", TEXT)
    writers = Writers(node.participant, {"/a": topic})
    reader = node.reader("/a", TEXT)
    for k in range(500):
        writers.write(topic, text(str(k)))
    assert writers.counts == {"/a": (500, 0)}, "nothing waited"
    assert [message.data for message in taken(reader, TEXT)] == [str(k) for k in range(490, 500)]
    assert writers.wanted == {"/a"}
    del reader
    until(lambda: writers.wanted == frozenset())


def test_writers_may_be_there_first(node: Node, caplog: pytest.LogCaptureFixture) -> None:
    came: list[tuple[str, bytes, str]] = []
    left: list[str] = []
    writer, other = node.writer("/a", TEXT), node.writer("/a", TEXT)
    hello = text("hello")
    with caplog.at_level(logging.ERROR, "armlab.bridge"):
        readers = Readers(node.participant, {"/a": TEXT}, lambda *one: came.append(one), left.append)
        until(writer.is_matched)
        writer.write(hello)
        until(lambda: came)
        writer.leave()
        until(lambda: len(readers._clients) == 1)
        assert left == [], "the client has another writer, which has not written yet"
        other.leave()
        until(lambda: left)
        readers.close()
    assert caplog.text == ""


@pytest.mark.parametrize("ends", [False, True])
def test_what_comes_while_a_reader_is_made_is_read(node: Node, monkeypatch: pytest.MonkeyPatch, ends: bool) -> None:
    """DDS calls the listener before the reader exists, and not again before the next message."""
    came: list[str] = []
    left: list[str] = []
    writer = node.writer("/a", TEXT)

    def made(*arguments: Any) -> DataReader[Any]:
        reader = DataReader(*arguments[:-1])  # as if its listener had been called already
        until(writer.is_matched)
        writer.write(text("hello"))
        until(lambda: reader.read(1))
        if ends:
            writer.leave()
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
            writer.write(text("hello"))
            until(lambda k=k: len(came) > k)
    until(lambda: caplog.text.count("ValueError: of the test") == 2)
    readers.close()


PUBLISHED = {one.type for one in Topics({ARM.name: ARM}, RowSchema.of([ARM])).published.values()}
TAKEN = set(Commands("cell", {ARM.name: ARM}).types.values())
BYTES = bytes.fromhex(  # JointState encoded by hand: 1.000000002 s, frame "f", joints a and b
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
        pytest.raises(LinkError, match=r"on 192\.0\.2\.1, got .* Use the address"),
        joined(free_domain(), "192.0.2.1"),
    ):
        pass
