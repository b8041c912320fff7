"""`Writers` and `Readers`: the endpoints of ROS topics on a participant, as QoS of ROS 2 would have them."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping
from typing import Any

from armlab.bridge.ros._cyclone import (
    DataReader,
    DataWriter,
    DomainParticipant,
    Listener,
    Policy,
    Qos,
    Topic,
    write_cdr,
)
from armlab.bridge.ros.dds_types import carrier, topic_name
from armlab.bridge.ros.topics import Published

__all__ = ["Readers", "Writers"]

_BLOCKED = 1_000_000  # ns that a write may wait, which none does that keeps the last only
_AT_ONCE = 16  # messages of one look
_PREFIX = 24  # hexadecimal digits of a GUID that all endpoints of a participant have
_XCDR1 = Policy.DataRepresentation(use_cdrv0_representation=True)  # all that ROS 2 speaks
_STATE = Qos(
    Policy.Reliability.Reliable(_BLOCKED), Policy.Durability.Volatile, Policy.History.KeepLast(10), _XCDR1
)  # never KeepAll: a reader that stopped would hold every write up
_COMMAND = Qos(Policy.Reliability.BestEffort, Policy.Durability.Volatile, Policy.History.KeepLast(1), _XCDR1)
_logger = logging.getLogger("armlab.bridge")


class Writers:
    """Writes topics that somebody reads.

    Parameters
    ----------
    participant : that they belong to. published : topics by full name.

    Attributes
    ----------
    wanted : names of topics that have a reader. counts : by name, messages written and such that found no room.
    """

    def __init__(self, participant: DomainParticipant, published: Mapping[str, Published]) -> None:
        self.wanted: frozenset[str] = frozenset()
        self.counts: dict[str, tuple[int, int]] = {}
        self._lock = threading.Lock()
        self._writers: dict[str, DataWriter[Any]] = {}
        for name, topic in published.items():
            listener = Listener(on_publication_matched=lambda _, status, name=name: self._matched(name, status))
            made = Topic(participant, topic_name(name), carrier(topic.type))
            self._writers[name] = DataWriter(participant, made, _STATE, listener)

    def write(self, topic: Published, cdr: bytes) -> None:
        """Send one message.

        Parameters
        ----------
        topic : where. cdr : a message, see `mould.cdr`.
        """
        written, full = self.counts.get(topic.name, (0, 0))
        went = write_cdr(self._writers[topic.name], cdr + bytes(-len(cdr) % 4))
        self.counts[topic.name] = (written + 1, full) if went else (written, full + 1)

    def close(self) -> None:
        """End all writers: none calls any more."""
        self._writers.clear()

    def _matched(self, name: str, status: Any) -> None:
        with self._lock:
            self.wanted = self.wanted | {name} if status.current_count else self.wanted - {name}


class Readers:
    """Reads topics; calls from threads of DDS.

    Parameters
    ----------
    participant : that they belong to. types : ROS 2 message type by full name of the topic.
    take : told the topic, its bytes and who wrote them. left : told the participant whose last writer has gone.
    """

    def __init__(
        self,
        participant: DomainParticipant,
        types: Mapping[str, str],
        take: Callable[[str, bytes, str], None],
        left: Callable[[str], None],
    ) -> None:
        self._take, self._left = take, left
        self._clients: dict[int, str] = {}
        self._readers: list[DataReader[Any]] = []
        self._lock = threading.Lock()  # in the order in which it came, though two threads look
        for name, type_ in types.items():
            listener = Listener(
                on_data_available=lambda reader, name=name: self._guarded(self._read, reader, name),
                on_subscription_matched=lambda reader, status: self._guarded(self._matched, reader, status),
            )
            made = Topic(participant, topic_name(name), carrier(type_))
            reader = DataReader(participant, made, _COMMAND, listener)
            self._readers.append(reader)
            self._guarded(self._begin, reader, name)

    def close(self) -> None:
        """End all readers: none calls any more, which it must not while Python ends."""
        self._readers.clear()

    def _guarded(self, call: Callable[..., None], reader: DataReader[Any] | None, *arguments: Any) -> None:
        """Call; what fails is told and no more, since it would come up in C.

        DDS may call as soon as it has the reader itself, in Python there is none or half of one then: `_begin` follows.
        """
        try:
            with self._lock:
                if reader in self._readers:
                    call(reader, *arguments)
        except Exception:
            _logger.exception("ros2")

    def _begin(self, reader: DataReader[Any], name: str) -> None:
        """Take up what was there before the reader was."""
        for handle in reader.get_matched_publications():
            self._client(reader, _handle(handle))
        self._read(reader, name)

    def _read(self, reader: DataReader[Any], name: str) -> None:
        known = set(self._clients)
        while samples := reader.take(_AT_ONCE):
            for sample in samples:
                if sample.sample_info.valid_data:  # else a writer that has gone
                    self._take(name, sample.cdr, self._client(reader, _handle(sample.sample_info.publication_handle)))
        if new := set(self._clients) - known:  # one that ended before it was known is not told as gone any more
            for handle in new.difference(map(_handle, reader.get_matched_publications())):
                self._gone(handle)

    def _matched(self, reader: DataReader[Any], status: Any) -> None:
        handle = _handle(status.last_publication_handle)
        if status.current_count_change > 0:
            self._client(reader, handle)
        else:
            self._gone(handle)

    def _gone(self, handle: int) -> None:
        client = self._clients.pop(handle, None)
        if client is not None and client not in list(self._clients.values()):
            self._left(client)

    def _client(self, reader: DataReader[Any], handle: int) -> str:
        """Return who writes: the participant's part of the GUID, or what DDS calls the writer here.

        All writers of a participant are one client: with one it commands, with another it sets a parameter.
        """
        if handle not in self._clients:
            about = reader.get_matched_publication_data(handle)
            self._clients[handle] = f"{handle % 2**64:016x}" if about is None else about.participant_key.hex[:_PREFIX]
        return self._clients[handle]


def _handle(number: int) -> int:
    """Return a handle as 64 bits with a sign: samples say it without one, conditions and calls with one."""
    return (int(number) + 2**63) % 2**64 - 2**63
