"""Endpoints on a participant: what has a reader is known, a writer that goes is told, and nothing comes up in C."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from typing import Any

import pytest

from armlab.bridge.servers.ros import Published, store
from armlab.bridge.servers.ros.message_template import cdr

from .dds_peers import Node, free_domain, numbers, taken, until, write

pytest.importorskip("cyclonedds", reason="the extra ros is not installed")

from armlab.bridge.servers.ros import dds
from armlab.bridge.servers.ros.dds import DataReader, Readers, Writers, joined

TEXT, ARRAY = "std_msgs/msg/String", "std_msgs/msg/Float64MultiArray"


def text(words: str) -> bytes:
    """A message of any number of bytes, also such that are no multiple of 4."""
    return cdr(store().types[TEXT](words), TEXT)


@pytest.fixture
def node() -> Iterator[Node]:
    domain = free_domain()
    with joined(domain, "127.0.0.1"):
        yield Node(domain)


def test_a_topic_is_wanted_while_it_has_a_reader(node: Node) -> None:
    topics = {name: Published(name, TEXT) for name in ("/a", "/b")}
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
    topic = Published("/a", TEXT)
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
