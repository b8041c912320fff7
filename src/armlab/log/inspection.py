"""`inspect`: what a recording holds besides its table."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from armlab.errors import LogError
from armlab.log.formats import check_readable
from armlab.log.mcap_decode import message_counts, messages
from armlab.log.mcap_records import DAMAGE, Contents, contents
from armlab.log.reading import opened
from armlab.wire import cdr

__all__ = ["Event", "Inspection", "Topic", "inspect"]

_EVENTS = "rcl_interfaces/msg/Log"


@dataclass(frozen=True, slots=True)
class Event:
    """One line of the events: its wall clock [ns] and its text."""

    stamp_ns: int
    text: str


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic of the file: name, message type, number of messages."""

    name: str
    type: str
    messages: int


@dataclass(frozen=True, slots=True)
class Inspection:
    """What a recording holds besides its table.

    Attributes
    ----------
    path, size : the file and its bytes. finished, torn : closed properly; bytes torn off at the end.
    metadata : records of string maps by name; "armlab" says what wrote the file, for which robot.
    topics, events : in order. attachments : bytes by name. summary : counts written at the end, empty if there is none.
    """

    path: Path
    size: int
    finished: bool
    torn: int
    metadata: Mapping[str, Mapping[str, str]]
    topics: tuple[Topic, ...]
    events: tuple[Event, ...]
    attachments: Mapping[str, bytes]
    summary: Mapping[str, Any]


def inspect(path: str | Path) -> Inspection:
    """Return metadata, topics, events, attachments and the summary of an MCAP file, finished or torn.

    Raises
    ------
    LogError : the file is missing, of another format, or damaged beyond use.
    """
    path = Path(path)
    check_readable(path)
    with opened(path) as view:
        try:
            found = contents(view)
            attachments = {attached.name: bytes(view[slice(*attached.data)]) for attached in found.attachments}
            return Inspection(
                path=path,
                size=len(view),
                finished=found.finished,
                torn=found.torn,
                metadata=found.metadata,
                topics=_topics(view, found),
                events=_events(view, found),
                attachments=attachments,
                summary=_summary(attachments),
            )
        except LogError:
            raise
        except DAMAGE as error:
            raise LogError(f"Expected a whole MCAP file at {path}, got a damaged one ({error}).") from None


def _topics(view: memoryview, found: Contents) -> tuple[Topic, ...]:
    counts = message_counts(view, found)
    return tuple(Topic(channel.topic, channel.type, counts[number]) for number, channel in found.channels.items())


def _events(view: memoryview, found: Contents) -> tuple[Event, ...]:
    events = []
    for number, channel in found.channels.items():
        if channel.type != _EVENTS or channel.encoding != "cdr":
            continue
        types = cdr.definitions(channel.type, channel.schema)
        for _, stamp_ns, raw in messages(view, found, number):
            try:
                events.append(Event(stamp_ns, str(cdr.layout(raw, channel.type, types).texts["msg"])))
            except DAMAGE:
                continue
    return tuple(events)


def _summary(attachments: Mapping[str, bytes]) -> Mapping[str, Any]:
    try:
        summary = json.loads(attachments.get("summary.json", b"{}"))
    except ValueError:
        return {}
    return summary if isinstance(summary, dict) else {}
