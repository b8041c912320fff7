"""Metadata, attachments and events of a recording, with secrets removed.

An attached file without secrets is kept byte for byte. Otherwise, the file is rewritten without comments, with secret
values replaced by ``***``. A file that cannot be parsed is omitted.
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
from armlab._files import parsed
from armlab.errors import LogError, ModelMismatchError, RobotError
from armlab.log.file_formats.opening import check_readable, naming, opened, undamaged
from armlab.log.mcap.decode import message_counts, messages
from armlab.log.mcap.records import DAMAGE, Contents, contents
from armlab.log.recording.columns import clocks, summary_of
from armlab.log.recording.ros_messages import topic_name
from armlab.robots import Robot, from_toml, to_toml
from armlab.robots.comparison import check_same
from armlab.wire import cdr

SECRET = re.compile(r"token|password|passwd|secret|api[-_ ]?key", re.IGNORECASE)
"""Pattern that matches the names of secret values."""

_TOLD = re.compile(rf"((?:{SECRET.pattern})[\w.-]*+[\"']?\s*[=:]\s*)\S[^\n]*", re.IGNORECASE)  # secrets within a string
_HIDDEN = "***"
_LEFT_OUT = b"# omitted: this file may contain a secret, but it could not be parsed\n"
_TOP = " "  # section name for the lines before the first section of an INI file


def redacted(name: str, data: bytes) -> bytes:
    """Return a file with its secrets removed."""
    if Path(name).suffix.lower() not in _FORMATS:
        return bytes(data)
    plain = data.replace(b"\0", b"").decode("latin-1")  # also finds UTF-16 names
    mentions = SECRET.search(plain) is not None
    if not mentions and "\\" not in plain:  # "\u0074oken" is also a name
        return bytes(data)
    read, write = _FORMATS[Path(name).suffix.lower()]
    try:
        held = read(data.decode("utf-8-sig"))
        told = _without(held, {})
        return write(told).encode() if mentions or told != held else bytes(data)
    except Exception:  # parsers raise undocumented errors on invalid input, such as AttributeError in configparser
        return _LEFT_OUT


def _without(value: Any, known: dict[int, Any]) -> Any:
    """Return nested tables, lists and strings without secrets; convert shared objects only once."""
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
    if isinstance(value, tuple | set):  # YAML pairs: keys and values are indistinguishable
        raise TypeError("not a table, list, string or number")
    return _TOLD.sub(rf"\1{_HIDDEN}", value) if isinstance(value, str) else value


def _from_yaml(text: str) -> list[Any]:
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
    """INI parser with string values and case-sensitive names."""

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
_PATIENCE = 2.0  # s, timeout for git


def metadata(robot: Robot, attachments: Mapping[str, bytes], note: str) -> dict[str, str]:
    """Return the metadata record of a recording, without secret options."""
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
    """Return the attachments of a recording by name: the robot's description, and the given files without secrets."""
    found: dict[str, bytes] = {}
    with suppress(RobotError):  # an invalid robot name must not stop the recording
        found[ROBOT] = to_toml(robot).encode()
    for name, data in attachments.items():
        found[name] = redacted(name, data)
    return found


def described(attachments: Mapping[str, bytes], name: str, origin: str) -> Robot | None:
    """Return the robot with a given name from the attachments of a recording, or None."""
    found = (
        from_toml(text.decode(errors="replace"), f"{origin}, {file}")
        for file, text in attachments.items()
        if file.startswith("robot") and file.endswith(".toml")
    )
    return next((robot for robot in found if robot.name == name), None)


@cache
def revision(folder: Path) -> str:
    """Return the commit of the folder's git repository, followed by + if files were modified; "" without a
    repository."""
    words = ["git", "-C", str(folder), "describe", "--always", "--abbrev=40", "--exclude=*", "--dirty=+"]
    try:
        alone = {**os.environ, "GIT_OPTIONAL_LOCKS": "0"}  # read-only access
        done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=_PATIENCE, env=alone)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""


def _without_secrets(words: list[str]) -> list[str]:
    """Replace the values of command-line options whose names indicate secrets."""
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
    stamp_ns: int
    text: str


@dataclass(frozen=True, slots=True)
class Setting:
    """Parameter change; `sequence` is 0 for the initial value, and `who` is the author."""

    stamp_ns: int
    sequence: int
    name: str
    value: Any
    who: str


@dataclass(frozen=True, slots=True)
class Topic:
    name: str
    type: str
    messages: int


@dataclass(frozen=True, slots=True)
class Inspection:
    """Content of a recording excluding its table.

    `size`: size of the file in bytes. `finished`: whether the file was closed properly. `torn`: number of bytes lost at
    the end. `metadata`: string maps by name; "armlab" describes the writing program and the robot. `attachments`: bytes
    by name. `summary`: counts written at the end, or empty. `robots`: names of the robots with rows.
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
    """Return the metadata, topics, events, attachments and summary of an MCAP file, finished or unfinished.

    Raises
    ------
    LogError : the file is missing, in another format, or too corrupt to read.
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
            events=_made(view, found, _EVENTS, lambda stamp_ns, _, held: Event(stamp_ns, str(held.texts["msg"]))),
            parameters=_made(view, found, _PARAMETERS, _setting),
            attachments={one.name: bytes(view[slice(*one.data)]) for one in found.attachments},
            summary=summary_of(view, found),
            robots=tuple(topic.strip("/").rpartition("/")[0] for topic in clocks(found).values()),
        )


def check_recorded(held: Inspection, robot: Robot) -> None:
    """Raise a `ModelMismatchError` unless a recording contains rows of a robot and an identical description of this
    robot."""
    about = {topic_name(pairs["robot"]): pairs for pairs in held.metadata.values() if pairs.get("robot")}
    names = held.robots if len(held.robots) > 1 else tuple(about)  # as in topic names, invalid characters are replaced
    pairs = about.get(topic_name(robot.name), about[names[0]] if len(names) == 1 else {})
    name, digest = pairs.get("robot", robot.name), pairs.get("robot_hash", "")
    advice = "Pass the robot that was recorded, or pass force=True (--force) to use this robot."
    if digest:
        recorded = described(held.attachments, name, str(held.path))
        check_same(robot, f"the recording {held.path}", name, digest, recorded, advice)
    elif names and topic_name(robot.name) not in names:
        got = " and ".join(repr(about[name]["robot"] if name in about else name) for name in names)
        raise ModelMismatchError(
            f"Expected a recording of {robot.name!r}, got a recording of {got} in {held.path}. {advice}"
        )


def _made(
    view: memoryview, found: Contents, type_: str, make: Callable[[int, bytes, cdr.Layout], One]
) -> tuple[One, ...]:
    """Return ``make(stamp [ns], bytes, layout)`` for each message of a type; corrupt messages are skipped."""
    made: list[One] = []
    for number, channel in found.channels.items():
        if channel.type != type_ or channel.encoding != "cdr":
            continue
        with suppress(LogError):  # another program's type without a valid schema
            types = cdr.definitions(channel.type, channel.schema, channel.schema_encoding)
            for _, stamp_ns, raw in messages(view, found, number):
                with suppress(*DAMAGE):
                    made.append(make(stamp_ns, bytes(raw), cdr.layout(raw, channel.type, types)))
    return tuple(made)


def _setting(stamp_ns: int, raw: bytes, held: cdr.Layout) -> Setting:
    place = held.field("sequence")
    sequence = 0 if place is None else int(np.frombuffer(raw[place.start : place.stop], place.dtype)[0])
    name, value, who = (str(held.texts[key]) for key in ("name", "value", "who"))
    return Setting(stamp_ns, sequence, name, json.loads(value), who)
