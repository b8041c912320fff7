"""rosbridge v2 in JSON: the operations that are understood, and messages in the dialects of ROS 1 and ROS 2.

Source: RobotWebTools/rosbridge_suite, ROSBRIDGE_PROTOCOL.md.
"""

from __future__ import annotations

import re
from functools import cache
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from armlab.bridge.servers.ros.topics import store
from armlab.errors import CommandRefused

__all__ = [
    "Advertise",
    "CallService",
    "Dialect",
    "HEADER",
    "LARGEST",
    "Level",
    "Operation",
    "Publish",
    "ServiceResponse",
    "SetLevel",
    "StatusOperation",
    "SubscribeOperation",
    "TIME",
    "Unadvertise",
    "Unsubscribe",
    "fields",
    "full_name",
    "id_of",
    "publish",
    "read_operation",
    "read_type",
    "type_name",
]

Dialect = Literal["ros1", "ros2"]

_TYPE = re.compile(r"([A-Za-z]\w{0,100})/(msg/)?([A-Za-z]\w{0,100})")
TIME, HEADER = "builtin_interfaces/msg/Time", "std_msgs/msg/Header"
_FILLER = "structure_needs_at_least_one_member"  # of types without a field, in rosbags


def read_type(text: str) -> tuple[str, Dialect]:
    """Return the ROS 2 name of a type, and the dialect that its text speaks."""
    found = _TYPE.fullmatch(text)
    if found is None:
        raise CommandRefused(
            f"Expected a type such as sensor_msgs/JointState or sensor_msgs/msg/JointState, got {text[:80]!r}."
        )
    package, is_ros2, name = found.groups()
    return f"{package}/msg/{name}", "ros2" if is_ros2 else "ros1"


def type_name(type_: str, dialect: Dialect) -> str:
    """Return the name of a type in a dialect."""
    return type_.replace("/msg/", "/") if dialect == "ros1" else type_


@cache
def fields(type_: str) -> tuple[str, ...]:
    """Return the names of the fields of a message."""
    return tuple(name for name, _ in store().fielddefs[type_][1] if name != _FILLER)


def publish(topic: str, message: Any, type_: str, dialect: Dialect, seq: int) -> bytes:
    """Return the operation "publish" of a message as JSON; a number that is not finite is null.

    The number of the message, `seq`, is in the headers of ROS 1.
    """
    return msgspec.json.encode({"op": "publish", "topic": topic, "msg": _plain(message, type_, dialect, seq)})


def _plain(message: Any, type_: str, dialect: Dialect, seq: int) -> dict[str, Any]:
    """Return a message as dictionaries, lists and numbers."""
    found = {}
    for name, ros1_name, inner, is_sequence in _shape(type_):
        value = getattr(message, name)
        if inner is not None:
            many = [_plain(one, inner, dialect, seq) for one in (value if is_sequence else [value])]
            value = many if is_sequence else many[0]
        elif isinstance(value, np.ndarray):
            value = value.tolist()
        found[ros1_name if dialect == "ros1" else name] = value
    return {"seq": seq, **found} if dialect == "ros1" and type_ == HEADER else found


@cache
def _shape(type_: str) -> list[tuple[str, str, str | None, bool]]:
    """Return of each field its name in ROS 2 and in ROS 1, the type of a message in it, and if it is a sequence."""
    names, found = {"sec": "secs", "nanosec": "nsecs"} if type_ == TIME else {}, []
    for name, (kind, inner) in store().fielddefs[type_][1]:
        if name != _FILLER:
            is_sequence = kind.name == "SEQUENCE"
            kind, inner = inner[0] if is_sequence else (kind, inner)
            found.append((name, names.get(name, name), inner if kind.name == "NAME" else None, is_sequence))
    return found


LARGEST = 65536
"""Bytes of an operation."""

Level = Literal["info", "warning", "error", "none"]

_Name = Annotated[str, msgspec.Meta(max_length=256)]


class _Operation(msgspec.Struct, frozen=True, tag_field="op"):
    """What every operation has."""

    id: _Name | int | None = None


class SubscribeOperation(_Operation, tag="subscribe", frozen=True, kw_only=True):
    """The client wants a topic."""

    topic: _Name
    type: _Name | None = None
    throttle_rate: Annotated[float, msgspec.Meta(ge=0, le=1e9)] | None = 0.0  # ms
    queue_length: Annotated[int, msgspec.Meta(ge=0, le=10000)] | None = 0
    compression: _Name | None = None
    fragment_size: int | None = None


class Unsubscribe(_Operation, tag="unsubscribe", frozen=True, kw_only=True):
    """It does not any more."""

    topic: _Name


class Advertise(_Operation, tag="advertise", frozen=True, kw_only=True):
    """The client is going to publish."""

    topic: _Name
    type: _Name


class Unadvertise(_Operation, tag="unadvertise", frozen=True, kw_only=True):
    """It is not any more."""

    topic: _Name


class Publish(_Operation, tag="publish", frozen=True, kw_only=True):
    """A message of the client."""

    topic: _Name
    msg: dict[str, Any] = {}


class CallService(_Operation, tag="call_service", frozen=True, kw_only=True):
    """A question."""

    service: _Name
    args: dict[str, Any] | list[Any] | None = None
    type: _Name | None = None


class ServiceResponse(_Operation, tag="service_response", frozen=True, kw_only=True):
    """An answer to a question that is never asked."""

    service: _Name = ""


class SetLevel(_Operation, tag="set_level", frozen=True, kw_only=True):
    """How much of what happens the client wants to hear."""

    level: Level


class StatusOperation(_Operation, tag="status", frozen=True):
    """What happened at the client's side."""


Operation = (
    SubscribeOperation
    | Unsubscribe
    | Advertise
    | Unadvertise
    | Publish
    | CallService
    | ServiceResponse
    | SetLevel
    | StatusOperation
)


class _Head(msgspec.Struct, frozen=True):
    """Fields read from an invalid operation, for the error message."""

    op: Any = None
    id: Any = None


_DECODER = msgspec.json.Decoder(Operation)
_HEAD = msgspec.json.Decoder(_Head)
_KNOWN = tuple(str(one.__struct_config__.tag) for one in Operation.__args__)
_REFUSED = {
    "fragment": "Expected whole messages: fragments are not taken. Send less at once.",
    "png": "Expected plain JSON: pictures of it are not taken.",
}
_WRONG = (msgspec.DecodeError, UnicodeDecodeError, RecursionError)


def read_operation(data: bytes | str) -> Operation:
    """Return the operation in a message of a client."""
    if isinstance(data, bytes):
        raise CommandRefused(f"Expected a text message with JSON, got a binary one of {len(data)} bytes.")
    if len(data) > LARGEST:
        raise CommandRefused(f"Expected at most {LARGEST} characters at once, got {len(data)}.")
    try:
        return _DECODER.decode(data)
    except _WRONG as error:
        raise CommandRefused(_why(data, error)) from None
    except UnicodeEncodeError:
        raise CommandRefused("Expected text in Unicode, got half a surrogate pair.") from None


def full_name(name: str) -> str:
    """Return the full name of a topic or service; clients may leave out the leading slash, as roslib 2 does."""
    return name if name.startswith("/") else f"/{name}"


def id_of(data: bytes | str) -> str | int | None:
    """Return the id that a message carries although it is no operation."""
    found = _head(data).id
    return found[:256] if isinstance(found, str) else found if isinstance(found, int) else None


def _head(data: bytes | str) -> _Head:
    try:
        return _HEAD.decode(data)
    except (*_WRONG, UnicodeEncodeError):
        return _Head()


def _why(data: str, error: Exception) -> str:
    op = _head(data).op
    if isinstance(op, str) and op not in _KNOWN:
        known = ", ".join(sorted(_KNOWN))
        return _REFUSED.get(op, f"Expected one of the operations {known}, got {op[:80]!r}.")
    return f"Expected an operation of rosbridge v2 in JSON, but {str(error).rstrip('.')}."
