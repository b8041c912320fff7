"""Metadata, attachments and events of a recording, and secrets that are taken out of them.

An attached file without secrets stays the same, to the byte. Otherwise its values are written anew: secret ones as
``***``, and without comments. A file that cannot be parsed is left out.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import platform
import re
import subprocess
import sys
from collections.abc import Callable, Mapping
from configparser import RawConfigParser
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import tomli_w

from armlab import __version__
from armlab._toml import parsed
from armlab.errors import LogError, RobotError
from armlab.log.file_formats.opening import check_readable, naming, opened, undamaged
from armlab.log.mcap.decode import message_counts, messages
from armlab.log.mcap.records import DAMAGE, Contents, contents
from armlab.log.recording.columns import clocks, summary_of
from armlab.robots import Robot, from_toml, to_toml
from armlab.wire import cdr

SECRET = re.compile(r"token|password|passwd|secret|api[-_ ]?key", re.IGNORECASE)
"""What a name has inside whose value is secret."""

_TOLD = re.compile(rf"((?:{SECRET.pattern})[\w.-]*+[\"']?\s*[=:]\s*)\S[^\n]*", re.IGNORECASE)  # within a text
_HIDDEN = "***"
_LEFT_OUT = b"# left out: it may hold a secret, and its values could not be told apart\n"
_TOP = " "  # name of a section for what comes before the first of an INI file


def redacted(name: str, data: bytes) -> bytes:
    """Return a file without its secrets."""
    if Path(name).suffix.lower() not in _FORMATS:
        return bytes(data)
    plain = data.replace(b"\0", b"").decode("latin-1")  # finds the names in UTF-16, too
    mentions = SECRET.search(plain) is not None
    if not mentions and "\\" not in plain:  # "\u0074oken" is a name, too
        return bytes(data)
    read, write = _FORMATS[Path(name).suffix.lower()]
    try:
        held = read(data.decode("utf-8-sig"))
        told = _without(held, {})
        return write(told).encode() if mentions or told != held else bytes(data)
    except Exception:  # what parsers raise on texts of others is nowhere listed: configparser an AttributeError
        return _LEFT_OUT


def _without(value: Any, known: dict[int, Any]) -> Any:
    """Return a value of tables, lists and texts without secrets; what stands in several places of it, once."""
    if id(value) in known:
        return known[id(value)]
    if isinstance(value, dict):
        table = known[id(value)] = {}
        for key, one in value.items():
            table[key] = _HIDDEN if SECRET.search(str(key)) else _without(one, known)
        return table
    if isinstance(value, list):
        items = known[id(value)] = []
        items += [_without(one, known) for one in value]
        return items
    if isinstance(value, tuple | set):  # pairs of YAML, whose keys are not told from other values
        raise TypeError("no table, list, text or number")
    return _TOLD.sub(rf"\1{_HIDDEN}", value) if isinstance(value, str) else value


def _from_yaml(text: str) -> list[Any]:
    """Return the documents of a file."""
    from ruamel.yaml import YAML

    parser = YAML(typ="safe", pure=True)
    parser.allow_duplicate_keys = True
    return list(parser.load_all(text))


def _to_yaml(documents: list[Any]) -> str:
    from ruamel.yaml import YAML

    writer, out = YAML(typ="safe", pure=True), io.StringIO()
    writer.default_flow_style = False
    writer.dump_all(documents, out)
    return out.getvalue()


class _Ini(RawConfigParser):
    """Settings in sections, each value a text; names keep their case."""

    def __init__(self) -> None:
        super().__init__(strict=False, allow_no_value=True, default_section="")

    def optionxform(self, optionstr: str) -> str:
        return optionstr


def _from_ini(text: str) -> dict[str, Any]:
    parser = _Ini()
    parser.read_string(f"[{_TOP}]\n{text}")
    return {section: dict(parser.items(section)) for section in parser.sections()}


def _to_ini(held: dict[str, Any]) -> str:
    parser, out = _Ini(), io.StringIO()
    parser.read_dict({name: values if isinstance(values, dict) else {_HIDDEN: None} for name, values in held.items()})
    parser.write(out)
    return out.getvalue().replace(f"[{_TOP}]\n", "", 1)


_FORMATS: dict[str, tuple[Callable[[str], Any], Callable[[Any], str]]] = {
    ".toml": (parsed, tomli_w.dumps),
    ".json": (json.loads, lambda held: json.dumps(held, indent=1) + "\n"),
    ".yaml": (_from_yaml, _to_yaml),
    ".yml": (_from_yaml, _to_yaml),
    ".cfg": (_from_ini, _to_ini),
    ".ini": (_from_ini, _to_ini),
}


ROBOT = "robot.toml"
_PATIENCE = 2.0  # s for git


def metadata(robot: Robot, attachments: Mapping[str, bytes], note: str) -> dict[str, str]:
    """Return the metadata record of a recording; values of secret options are replaced."""
    return {
        "version": __version__,
        "revision": revision(Path.cwd()),
        "command": " ".join(_without_secrets(sys.argv)),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "robot": robot.name,
        "robot_hash": robot.hash,
        "attachments": json.dumps({name: hashlib.sha256(data).hexdigest() for name, data in attachments.items()}),
        "note": note,
    }


def attached(robot: Robot, attachments: Mapping[str, bytes]) -> dict[str, bytes]:
    """Return what is attached to a recording, name -> bytes: the robot's description, and settings without secrets."""
    found: dict[str, bytes] = {}
    with suppress(RobotError):  # a name that cannot stand in a file must not cost the recording
        found[ROBOT] = to_toml(robot).encode()
    for name, data in attachments.items():
        found[name] = redacted(name, data)
    return found


def described(attachments: Mapping[str, bytes], name: str, origin: str) -> Robot | None:
    """Return the robot of a name as the attachments of a recording describe it, None where none of them does."""
    found = (
        from_toml(text.decode(errors="replace"), f"{origin}, {file}")
        for file, text in attachments.items()
        if file.startswith("robot") and file.endswith(".toml")
    )
    return next((robot for robot in found if robot.name == name), None)


@cache
def revision(folder: Path) -> str:
    """Return the commit of the git repository that a folder is in, with + where files differ; empty without one."""
    words = ["git", "-C", str(folder), "describe", "--always", "--abbrev=40", "--exclude=*", "--dirty=+"]
    try:
        alone = {**os.environ, "GIT_OPTIONAL_LOCKS": "0"}  # it only looks
        done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=_PATIENCE, env=alone)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""


def _without_secrets(words: list[str]) -> list[str]:
    """Replace what follows an option whose name tells a secret, and what such an option equals."""
    kept: list[str] = []
    hide = False
    for word in words:
        option, equals, _ = word.partition("=")
        secret = option.startswith("-") and bool(SECRET.search(option))
        kept.append("***" if hide else f"{option}=***" if secret and equals else word)
        hide = secret and not equals
    return kept


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
    with opened(path) as view, naming(path), undamaged(f"MCAP file at {path}", DAMAGE):
        found = contents(view)
        counts = message_counts(view, found)
        return Inspection(
            path=path,
            size=len(view),
            finished=found.finished,
            torn=found.torn,
            metadata=found.metadata,
            topics=tuple(Topic(one.topic, one.type, counts[number]) for number, one in found.channels.items()),
            events=_made(view, found, _EVENTS, _event),
            parameters=_made(view, found, _PARAMETERS, _setting),
            attachments={one.name: bytes(view[slice(*one.data)]) for one in found.attachments},
            summary=summary_of(view, found),
            robots=tuple(topic.strip("/").rpartition("/")[0] for topic in clocks(found).values()),
        )


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
