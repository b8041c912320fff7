"""`inspect`: what a recording holds besides its table."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from armlab.errors import LogError
from armlab.log.file_formats.opening import check_readable, naming, opened
from armlab.log.mcap.decode import message_counts, messages
from armlab.log.mcap.records import DAMAGE, Contents, contents
from armlab.log.recording.columns import clocks, summary_of
from armlab.wire import cdr

_EVENTS = "rcl_interfaces/msg/Log"
_PARAMETERS = "armlab_msgs/msg/Parameter"
One = TypeVar("One")


@dataclass(frozen=True, slots=True)
class Event:
    """One line of the events: its wall clock [ns] and its text."""

    stamp_ns: int
    text: str


@dataclass(frozen=True, slots=True)
class Setting:
    """A value of a parameter that came into force: wall clock [ns], number (0 at the start), what, and who set it."""

    stamp_ns: int
    sequence: int
    name: str
    value: Any
    who: str


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic of the file: name, message type, number of messages."""

    name: str
    type: str
    messages: int


@dataclass(frozen=True, slots=True)
class Inspection:
    """What a recording holds besides its table.

    `path`, `size`: the file and its bytes; `finished`, `torn`: closed properly; bytes torn off at the end; `metadata`:
    records of string maps by name; "armlab" says what wrote the file, for which robot; `topics`, `events`,
    `parameters`: in order; `attachments`: bytes by name; `summary`: counts written at the end, empty if there is none;
    `robots`: whose rows it holds.
    """

    path: Path
    size: int
    finished: bool
    torn: int
    metadata: Mapping[str, Mapping[str, str]]
    topics: tuple[Topic, ...]
    events: tuple[Event, ...]
    parameters: tuple[Setting, ...]
    attachments: Mapping[str, bytes]
    summary: Mapping[str, Any]
    robots: tuple[str, ...]


def inspect(path: str | Path) -> Inspection:
    """Return metadata, topics, events, attachments and the summary of an MCAP file, finished or torn.

    Raises
    ------
    LogError : the file is missing, of another format, or damaged beyond use.
    """
    path = Path(path)
    check_readable(path)
    with opened(path) as view, naming(path):
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
                events=_made(view, found, _EVENTS, _event),
                parameters=_made(view, found, _PARAMETERS, _setting),
                attachments=attachments,
                summary=summary_of(view, found),
                robots=tuple(topic.strip("/").rpartition("/")[0] for topic in clocks(found).values()),
            )
        except LogError:
            raise
        except DAMAGE as error:
            raise LogError(f"Expected a whole MCAP file at {path}, got a damaged one ({error}).") from None


def _topics(view: memoryview, found: Contents) -> tuple[Topic, ...]:
    counts = message_counts(view, found)
    return tuple(Topic(channel.topic, channel.type, counts[number]) for number, channel in found.channels.items())


def _made(
    view: memoryview, found: Contents, type_: str, make: Callable[[int, bytes, cdr.Layout], One]
) -> tuple[One, ...]:
    """Return what is made of stamp [ns], bytes and layout of each message of a type; damaged ones are left out."""
    made: list[One] = []
    for number, channel in found.channels.items():
        if channel.type != type_ or channel.encoding != "cdr":
            continue
        with suppress(LogError):  # a type of another program's, which its schema does not tell
            types = cdr.definitions(channel.type, channel.schema, channel.schema_encoding)
            for _, stamp_ns, raw in messages(view, found, number):
                with suppress(*DAMAGE):
                    made.append(make(stamp_ns, bytes(raw), cdr.layout(raw, channel.type, types)))
    return tuple(made)


def _event(stamp_ns: int, raw: bytes, held: cdr.Layout) -> Event:
    return Event(stamp_ns, str(held.texts["msg"]))


def _setting(stamp_ns: int, raw: bytes, held: cdr.Layout) -> Setting:
    place = held.field("sequence")
    sequence = 0 if place is None else int(np.frombuffer(raw[place.start : place.stop], place.dtype)[0])
    name, value, who = (str(held.texts[key]) for key in ("name", "value", "who"))
    return Setting(stamp_ns, sequence, name, json.loads(value), who)
