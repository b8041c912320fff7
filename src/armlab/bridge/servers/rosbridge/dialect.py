"""The two dialects of rosbridge: names of types and stamps as ROS 1 or as ROS 2 has them, told by the type's text."""

from __future__ import annotations

import re
from functools import cache
from typing import Any, Literal

import msgspec
import numpy as np

from armlab.bridge.servers.ros.types import store
from armlab.errors import CommandRefused

__all__ = ["HEADER", "TIME", "Dialect", "fields", "publish", "read_type", "type_name"]

Dialect = Literal["ros1", "ros2"]

_TYPE = re.compile(r"([A-Za-z]\w{0,100})/(msg/)?([A-Za-z]\w{0,100})")
TIME, HEADER = "builtin_interfaces/msg/Time", "std_msgs/msg/Header"
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


def publish(topic: str, message: Any, type_: str, dialect: Dialect, seq: int) -> bytes:
    """Return the operation "publish" of a message as JSON; a number that is not finite is null.

    message : of `ros.store`. type_ : its ROS 2 name. seq : number of the message, which the headers of ROS 1 carry.
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
