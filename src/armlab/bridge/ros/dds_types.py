"""ROS 2's names and message types as DDS has them (design.ros2.org, "Topic and Service name mapping to DDS").

Types are final, without keys, so that their bytes are those of `store`: a writer and a reader here carry bytes.
"""

from __future__ import annotations

from functools import cache
from typing import Any

from rosbags.interfaces import Nodetype

from armlab.bridge.ros._cyclone import make_idl_struct, types
from armlab.bridge.ros.ros2 import type_name
from armlab.bridge.ros.types import store

__all__ = ["carrier", "struct", "topic_name"]

_BASE: dict[str, Any] = {
    "bool": bool,
    "byte": types.byte,
    "uint8": types.uint8,
    "int32": types.int32,
    "uint32": types.uint32,
    "float64": types.float64,
    "string": str,
}


def topic_name(name: str) -> str:
    """Return the DDS name of a ROS topic.

    Parameters
    ----------
    name : full, for example "/yumi_left/joint_states".
    """
    return f"rt{name}"


@cache
def struct(name: str) -> Any:
    """Return a message type as a dataclass of cyclonedds, which has a codec of its own.

    Parameters
    ----------
    name : of a type of `store`, for example "sensor_msgs/msg/JointState".
    """
    return _made(name, is_dataclass=True)


@cache
def carrier(name: str) -> Any:
    """Return the type for a topic, whose objects hold the bytes of a message as attribute `cdr`.

    Encoding by `store` takes a third of the time of cyclonedds's own codec.

    Parameters
    ----------
    name : of a type of `store`.
    """
    made = _made(name, is_dataclass=False)
    made.__init__, made.serialize = _hold, _held
    made.deserialize = made.deserialize_key = classmethod(_taken)
    return made


def _made(name: str, is_dataclass: bool) -> Any:
    members = {member: _member(*about) for member, about in store().fielddefs[name][1]}
    return make_idl_struct(f"{name.rpartition('/')[2]}_", type_name(name), members, dataclassify=is_dataclass)


def _member(kind: Nodetype, about: Any) -> Any:
    if kind == Nodetype.BASE:
        return _BASE[about[0]]
    if kind == Nodetype.NAME:
        return struct(about)
    if kind == Nodetype.SEQUENCE:
        return types.sequence[_member(*about[0])]
    raise NotImplementedError(f"Expected no fixed array in a message of ours, got {about}.")


def _hold(self: Any, cdr: bytes) -> None:
    self.cdr = cdr


def _held(self: Any, *_: Any, **__: Any) -> bytes:
    return self.cdr


def _taken(cls: Any, data: bytes, *_: Any, **__: Any) -> Any:
    return cls(bytes(data))
