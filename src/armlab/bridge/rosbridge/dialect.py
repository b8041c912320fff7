"""The two dialects of rosbridge: names of types and stamps as ROS 1 or as ROS 2 has them, told by the type's text."""

from __future__ import annotations

import re
from functools import cache
from typing import Any, Literal

import msgspec
import numpy as np

from armlab.bridge.ros import store
from armlab.errors import CommandRefused

__all__ = ["HEADER", "TIME", "Dialect", "encoded", "fields", "read_type", "type_name"]

Dialect = Literal["ros1", "ros2"]

_TYPE = re.compile(r"([A-Za-z]\w{0,100})/(msg/)?([A-Za-z]\w{0,100})")
TIME, HEADER = "builtin_interfaces/msg/Time", "std_msgs/msg/Header"
_FILLER = "structure_needs_at_least_one_member"  # of types without a field, in rosbags


def read_type(text: str) -> tuple[str, Dialect]:
    """Return the ROS 2 name of a type, and the dialect that its text speaks.

    Parameters
    ----------
    text : "sensor_msgs/JointState" or "sensor_msgs/msg/JointState".

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

    Parameters
    ----------
    type_ : its ROS 2 name. dialect : of the client.
    """
    return type_.replace("/msg/", "/") if dialect == "ros1" else type_


@cache
def fields(type_: str) -> tuple[str, ...]:
    """Return the names of the fields of a message.

    Parameters
    ----------
    type_ : its ROS 2 name, of `ros.store`.
    """
    return tuple(name for name, _ in store().fielddefs[type_][1] if name != _FILLER)


def encoded(topic: str, message: Any, dialect: Dialect, seq: int) -> bytes:
    """Return the operation "publish" of a message as JSON; a number that is not finite is null.

    Parameters
    ----------
    topic : its full name. message : of `ros.store`. dialect : of the client.
    seq : number of the message, which the headers of ROS 1 carry.
    """
    return _ENCODER.encode({"op": "publish", "topic": topic, "msg": _plain(message, dialect, seq)})


def _plain(value: Any, dialect: Dialect, seq: int) -> Any:
    type_ = getattr(value, "__msgtype__", None)
    if type_ is None:
        if isinstance(value, list) and value and hasattr(value[0], "__msgtype__"):
            return [_plain(one, dialect, seq) for one in value]
        return value
    if dialect == "ros1" and type_ == TIME:
        return {"secs": value.sec, "nsecs": value.nanosec}
    known = {name: _plain(getattr(value, name), dialect, seq) for name in fields(type_)}
    return {"seq": seq, **known} if dialect == "ros1" and type_ == HEADER else known


def _builtin(value: np.ndarray) -> Any:
    return value.tolist()


_ENCODER = msgspec.json.Encoder(enc_hook=_builtin)
