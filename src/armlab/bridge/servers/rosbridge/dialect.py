"""The two dialects of rosbridge: names of types and stamps as ROS 1 or as ROS 2 has them, told by the type's text."""

from __future__ import annotations

import re
import struct
from functools import cache, lru_cache
from typing import Any, Literal

import msgspec

from armlab.bridge.servers.ros import store
from armlab.errors import CommandRefused
from armlab.kernels import JsonText

__all__ = ["HEADER", "TIME", "Dialect", "fields", "flat", "publish", "read_type", "type_name"]

Dialect = Literal["ros1", "ros2"]

_TYPE = re.compile(r"([A-Za-z]\w{0,100})/(msg/)?([A-Za-z]\w{0,100})")
TIME, HEADER = "builtin_interfaces/msg/Time", "std_msgs/msg/Header"
_SLOT, _SEQ_SLOT = b"\0", b"\2"  # of a number, of the number of the message: JSON has no such bytes
_SLOTS = re.compile(b"([\0\2])")
_SEQ = struct.Struct("<Q")
_KNOWN = 256  # texts that are kept: those of diagnostics change
_FILLER = "structure_needs_at_least_one_member"  # of types without a field, in rosbags


def read_type(text: str) -> tuple[str, Dialect]:
    """Return the ROS 2 name of a type, and the dialect that its text speaks.

    Raises
    ------
    CommandRefused : no name of a type; a sentence for the client.
    """
    found = _TYPE.fullmatch(text)
    if found is None:
        raise CommandRefused(
            f"Expected a type such as sensor_msgs/JointState or sensor_msgs/msg/JointState, got {text[:80]!r}."
        )
    package, is_ros2, name = found.groups()
    return f"{package}/msg/{name}", "ros2" if is_ros2 else "ros1"


def type_name(type_: str, dialect: Dialect) -> str:
    """Return the name of a type in a dialect.

    type_ : its ROS 2 name. dialect : of the client.
    """
    return type_.replace("/msg/", "/") if dialect == "ros1" else type_


@cache
def fields(type_: str) -> tuple[str, ...]:
    """Return the names of the fields of a message.

    type_ : its ROS 2 name, of `ros.store`.
    """
    return tuple(name for name, _ in store().fielddefs[type_][1] if name != _FILLER)


def flat(message: Any, type_: str) -> bytes:
    """Return a message as the text of its JSON with the numbers apart, packed, so that others can replace them.

    Text with a byte 0 for each number, what `struct` calls the numbers, and the numbers, between bytes 1: JSON has no
    such bytes. A byte stands before each array and after a stamp, so that `Encoded` can tell them apart.

    message : of `ros.store`. type_ : its ROS 2 name.
    """
    form: list[str] = ["<"]
    numbers: list[Any] = []
    text = msgspec.json.encode(_opened(message, type_, form, numbers))
    letters = "".join(form)
    return b"\1".join([text, letters.encode(), struct.pack(letters, *numbers)])


def publish(topic: str, message: bytes, dialect: Dialect, seq: int) -> bytes:
    """Return the operation "publish" of a message as JSON; a number that is not finite is null.

    seq : number of the message, which the headers of ROS 1 carry.
    """
    text, form, packed = message.split(b"\1", 2)
    made = _text(topic, text, form, dialect)
    return made.of(packed + _SEQ.pack(seq) if dialect == "ros1" else packed)


@lru_cache(_KNOWN)
def _text(topic: str, text: bytes, form: bytes, dialect: Dialect) -> JsonText:
    """Return what puts the numbers into a text: those of `flat` and, in ROS 1, one more behind them.

    What ROS 1 calls otherwise is replaced: quotes in a string of JSON stand behind a backslash, so no string holds it.
    """
    places, size = [], 0
    for letter in form[1:].decode():
        if letter != "x":
            places.append((size, letter.encode()))
        size += struct.calcsize(f"<{letter}")
    if dialect == "ros1":
        text = text.replace(b'{"sec":', b'{"secs":').replace(b',"nanosec":', b',"nsecs":')
        text = text.replace(b'{"stamp":{', b'{"seq":%b,"stamp":{' % _SEQ_SLOT)
    numbers = iter(places)
    parts = _SLOTS.split(b'{"op":"publish","topic":"%b","msg":%b}' % (topic.encode(), text))
    return JsonText(parts[::2], [next(numbers) if one == _SLOT else (size, b"Q") for one in parts[1::2]])


def _opened(message: Any, type_: str, form: list[str], numbers: list[Any]) -> dict[str, Any]:
    """Return a message as JSON takes it, with slots for numbers, which are found in their order."""
    shapes = store().fielddefs[type_][1]
    return {name: _part(getattr(message, name), shape, form, numbers) for name, shape in shapes if name != _FILLER}


def _part(value: Any, shape: Any, form: list[str], numbers: list[Any]) -> Any:
    kind, inner = shape
    if kind.name in ("ARRAY", "SEQUENCE"):
        form.append("x")
        return [_part(one, inner[0], form, numbers) for one in value]
    if kind.name == "NAME":
        opened = _opened(value, inner, form, numbers)
        if inner == TIME:
            form.append("x")
        return opened
    letter = _LETTERS.get(inner[0])
    if letter is None:
        return value
    form.append(letter)
    numbers.append(value)
    return msgspec.Raw(_SLOT)


_LETTERS = {
    "bool": "?", "byte": "B", "octet": "B", "char": "B", "float32": "f", "float64": "d", "int8": "b", "uint8": "B",
    "int16": "h", "uint16": "H", "int32": "i", "uint32": "I", "int64": "q", "uint64": "Q",
}  # fmt: skip
