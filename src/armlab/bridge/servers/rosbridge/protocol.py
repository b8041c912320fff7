"""rosbridge v2 in JSON: operations, messages in ROS 1 and ROS 2 dialects, and the rosapi services.

Source: RobotWebTools/rosbridge_suite, ROSBRIDGE_PROTOCOL.md.
"""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable, Mapping
from functools import cache
from types import MappingProxyType
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from armlab.bridge.servers.ros.topics import store
from armlab.errors import CommandRefused, UnknownName

Dialect = Literal["ros1", "ros2"]

_TYPE = re.compile(r"([A-Za-z]\w{0,100})/(msg/)?([A-Za-z]\w{0,100})")
TIME, HEADER = "builtin_interfaces/msg/Time", "std_msgs/msg/Header"
_FILLER = "structure_needs_at_least_one_member"  # field that rosbags adds to empty types


def read_type(text: str) -> tuple[str, Dialect]:
    """Return the ROS 2 name of a type and the dialect of the given spelling."""
    found = _TYPE.fullmatch(text)
    if found is None:
        raise CommandRefused(
            f"Expected a type such as sensor_msgs/JointState or sensor_msgs/msg/JointState, got {text[:80]!r}."
        )
    package, is_ros2, name = found.groups()
    return f"{package}/msg/{name}", "ros2" if is_ros2 else "ros1"


def type_name(type_: str, dialect: Dialect) -> str:
    return type_.replace("/msg/", "/") if dialect == "ros1" else type_


@cache
def fields(type_: str) -> tuple[str, ...]:
    return tuple(name for name, _ in store().fielddefs[type_][1] if name != _FILLER)


def publish(topic: str, message: Any, type_: str, dialect: Dialect, seq: int) -> bytes:
    """Return the "publish" operation of a message as JSON; ROS 1 headers get `seq`; NaN and infinity become null."""
    return msgspec.json.encode({"op": "publish", "topic": topic, "msg": _plain(message, type_, dialect, seq)})


def _plain(message: Any, type_: str, dialect: Dialect, seq: int) -> dict[str, Any]:
    """Convert a message to dictionaries, lists and numbers."""
    names = {"sec": "secs", "nanosec": "nsecs"} if dialect == "ros1" and type_ == TIME else {}
    found = {}
    for name, (part, length) in _parts(type_, "ros2").items():
        value = getattr(message, name)
        if "/" in part:
            many = [_plain(one, part, dialect, seq) for one in (value if length >= 0 else [value])]
            value = many if length >= 0 else many[0]
        elif isinstance(value, np.ndarray):
            value = value.tolist()
        found[names.get(name, name)] = value
    return {"seq": seq, **found} if dialect == "ros1" and type_ == HEADER else found


LARGEST = 2**18
"""Maximum size of an operation [bytes]."""

Level = Literal["info", "warning", "error", "none"]

_Name = Annotated[str, msgspec.Meta(max_length=256)]


class _Operation(msgspec.Struct, frozen=True, tag_field="op"):
    """Common fields of all operations."""

    id: _Name | int | None = None


class SubscribeOperation(_Operation, tag="subscribe", frozen=True, kw_only=True):
    """Subscribe to a topic."""

    topic: _Name
    type: _Name | None = None
    throttle_rate: Annotated[float, msgspec.Meta(ge=0, le=1e9)] | None = 0.0  # ms
    queue_length: Annotated[int, msgspec.Meta(ge=0, le=10000)] | None = 0
    compression: _Name | None = None
    fragment_size: int | None = None


class Unsubscribe(_Operation, tag="unsubscribe", frozen=True, kw_only=True):
    """End a subscription."""

    topic: _Name


class Advertise(_Operation, tag="advertise", frozen=True, kw_only=True):
    """Announce messages on a topic."""

    topic: _Name
    type: _Name


class Unadvertise(_Operation, tag="unadvertise", frozen=True, kw_only=True):
    """Withdraw an announcement."""

    topic: _Name


class Publish(_Operation, tag="publish", frozen=True, kw_only=True):
    """Message from a client."""

    topic: _Name
    msg: dict[str, Any] = {}


class SendActionGoal(_Operation, tag="send_action_goal", frozen=True, kw_only=True):
    """Action goal from a client."""

    action: _Name
    action_type: _Name | None = None
    args: dict[str, Any] = {}
    feedback: bool = False


class CancelActionGoal(_Operation, tag="cancel_action_goal", frozen=True, kw_only=True):
    """Cancellation of a goal by its id."""

    action: _Name


class CallService(_Operation, tag="call_service", frozen=True, kw_only=True):
    """Service call from a client."""

    service: _Name
    args: dict[str, Any] | list[Any] | None = None
    type: _Name | None = None


class ServiceResponse(_Operation, tag="service_response", frozen=True, kw_only=True):
    """Response from a client's service, which is never called."""

    service: _Name = ""


class SetLevel(_Operation, tag="set_level", frozen=True, kw_only=True):
    """Level of status messages for the client."""

    level: Level


class StatusOperation(_Operation, tag="status", frozen=True):
    """Status message from a client."""


Operation = (
    SubscribeOperation
    | Unsubscribe
    | Advertise
    | Unadvertise
    | Publish
    | SendActionGoal
    | CancelActionGoal
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
    "fragment": "Expected complete messages, because fragments are not supported. Send smaller messages.",
    "png": "Expected plain JSON, because PNG compression is not supported.",
}
_WRONG = (msgspec.DecodeError, UnicodeDecodeError, RecursionError)


def read_operation(data: bytes | str) -> Operation:
    if isinstance(data, bytes):
        raise CommandRefused(f"Expected a text message in JSON, got a binary message of {len(data)} bytes.")
    if len(data) > LARGEST:
        raise CommandRefused(f"Expected a message of at most {LARGEST} characters, got {len(data)}.")
    try:
        return _DECODER.decode(data)
    except _WRONG as error:
        raise CommandRefused(_why(data, error)) from None
    except UnicodeEncodeError:
        raise CommandRefused("Expected valid Unicode text, got an unpaired surrogate.") from None


def full_name(name: str) -> str:
    """Return the full name of a topic or service; roslib 2 omits the leading slash."""
    return name if name.startswith("/") else f"/{name}"


def id_of(data: bytes | str) -> str | int | None:
    """Return the id in a message that is not a valid operation."""
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
    return f"Expected a rosbridge v2 operation in JSON, got {str(error).rstrip('.')}."


SET_PARAM = "/rosapi/set_param"
CANCEL = "/_action/cancel_goal"

Arguments = Mapping[str, Any]


def parameter_name(arguments: Arguments, known: Mapping[str, Any]) -> str:
    """Return the name of a parameter given as "gain", "/gain" or "/node:gain"."""
    name = arguments.get("name")
    found = name.rpartition(":")[2].lstrip("/") if isinstance(name, str) else ""
    if found not in known:
        raise UnknownName.among("parameter", str(name)[:80], known)
    return found


class Rosapi:
    """rosapi services that need no answer from the loop."""

    def __init__(
        self,
        cell: str,
        topics: Mapping[str, str],
        parameters: Callable[[], Mapping[str, Mapping[str, Any]]],
        actions: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        self._cell, self._topics, self._parameters = cell, dict(topics), parameters
        self._actions = dict(actions)
        self._made: dict[str, tuple[str, tuple[str, ...], Callable[[Arguments, Dialect], dict[str, Any]]]] = {
            "topics": ("Topics", (), self._all_topics),
            "topic_type": ("TopicType", ("topic",), self._topic_type),
            "topics_for_type": ("TopicsForType", ("type",), self._topics_for_type),
            "services": ("Services", (), lambda given, dialect: {"services": list(self.services)}),
            "service_type": ("ServiceType", ("service",), self._service_type),
            "action_servers": ("GetActionServers", (), lambda given, dialect: {"action_servers": list(self._actions)}),
            "action_type": ("GetActionType", ("action",), self._action_type),
            "nodes": ("Nodes", (), lambda given, dialect: {"nodes": [f"/{self._cell}"]}),
            "get_time": ("GetTime", (), _time),
            "message_details": ("MessageDetails", ("type",), _details),
            "get_param_names": ("GetParamNames", (), lambda given, dialect: {"names": list(self._parameters())}),
            "get_param": ("GetParam", ("name", "default"), self._get_param),
            "has_param": ("HasParam", ("name",), self._has_param),
            "delete_param": ("DeleteParam", ("name",), _refuse_to_delete),
            "set_param": ("SetParam", ("name", "value"), lambda given, dialect: {}),  # set by the loop; see `Engine`
        }
        self.services: tuple[str, ...] = tuple(f"/rosapi/{name}" for name in self._made)

    def arguments(self, service: str, given: dict[str, Any] | list[Any] | None) -> Arguments:
        full = full_name(service)
        if full not in self.services:
            raise UnknownName.among("service", service[:80], self.services)
        names = self._made[full.removeprefix("/rosapi/")][1]
        return dict(zip(names, given)) if isinstance(given, list) else given or {}

    def answer(self, service: str, arguments: Arguments, dialect: Dialect) -> dict[str, Any]:
        return self._made[full_name(service).removeprefix("/rosapi/")][2](arguments, dialect)

    def _all_topics(self, given: Arguments, dialect: Dialect) -> dict[str, Any]:
        types = [type_name(type_, dialect) for type_ in self._topics.values()]
        return {"topics": list(self._topics), "types": types}

    def _topic_type(self, given: Arguments, dialect: Dialect) -> dict[str, Any]:
        type_ = self._topics.get(full_name(_text(given, "topic")))
        return {"type": "" if type_ is None else type_name(type_, dialect)}

    def _action_type(self, given: Arguments, dialect: Dialect) -> dict[str, Any]:
        return {"type": self._actions.get(full_name(_text(given, "action")), "")}

    def _topics_for_type(self, given: Arguments, dialect: Dialect) -> dict[str, Any]:
        wanted, _ = read_type(_text(given, "type"))
        return {"topics": [topic for topic, type_ in self._topics.items() if type_ == wanted]}

    def _service_type(self, given: Arguments, dialect: Dialect) -> dict[str, Any]:
        package = "rosapi" if dialect == "ros1" else "rosapi_msgs/srv"
        known = {f"/rosapi/{name}": f"{package}/{type_}" for name, (type_, _, _) in self._made.items()}
        return {"type": known.get(full_name(_text(given, "service")), "")}

    def _get_param(self, given: Arguments, dialect: Dialect) -> dict[str, Any]:
        known, default = self._parameters(), given.get("default")
        try:
            return {"value": json.dumps(known[parameter_name(given, known)]["value"])}
        except UnknownName:
            if isinstance(default, str) and default:
                return {"value": default}
            raise

    def _has_param(self, given: Arguments, dialect: Dialect) -> dict[str, Any]:
        try:
            return {"exists": bool(parameter_name(given, self._parameters()))}
        except UnknownName:
            return {"exists": False}


def _text(given: Arguments, name: str) -> str:
    found = given.get(name)
    if not isinstance(found, str):
        raise CommandRefused(f"Expected {name!r} to be a string, got {str(found)[:80]!r}.")
    return found


def _time(given: Arguments, dialect: Dialect) -> dict[str, Any]:
    seconds, ns = divmod(time.time_ns(), 1_000_000_000)
    names = ("secs", "nsecs") if dialect == "ros1" else ("sec", "nanosec")
    return {"time": dict(zip(names, (seconds, ns)))}


def _refuse_to_delete(given: Arguments, dialect: Dialect) -> dict[str, Any]:
    raise CommandRefused(
        "Expected a request to read or set a parameter, because declared parameters cannot be deleted."
    )


def _details(given: Arguments, dialect: Dialect) -> dict[str, Any]:
    """Return the fields of a type and of its nested types, in the dialect of the given spelling."""
    type_, spelling = read_type(_text(given, "type"))
    known = store().fielddefs
    if type_ not in known:
        raise CommandRefused(
            f"Expected a message type used by the topics of this cell, got {type_[:80]!r}. See /rosapi/topics."
        )
    found: list[dict[str, Any]] = []
    waiting, seen = [type_], {type_}
    while waiting:
        one = waiting.pop(0)
        parts = _parts(one, spelling)
        found.append(
            {
                "type": type_name(one, spelling),
                "fieldnames": list(parts),
                "fieldtypes": [type_name(part, spelling) for part, _ in parts.values()],
                "fieldarraylen": [length for _, length in parts.values()],
                "examples": [_example(part, length) for part, length in parts.values()],
                "constnames": [name for name, _, _ in known[one][0]],
                "constvalues": [str(value) for _, _, value in known[one][0]],
            }
        )
        new = [part for part, _ in parts.values() if part in known and part not in seen]
        waiting += dict.fromkeys(new)
        seen.update(new)
    return {"typedefs": found}


@cache
def _parts(type_: str, dialect: Dialect) -> dict[str, tuple[str, int]]:
    """Return the type and length of each field of a message, by name."""
    shapes = dict(store().fielddefs[type_][1])
    found = {name: _kind(shapes[name]) for name in fields(type_)}
    if dialect == "ros1":
        found = {name: ("time" if part == TIME else part, length) for name, (part, length) in found.items()}
    return {"seq": ("uint32", -1), **found} if dialect == "ros1" and type_ == HEADER else found


def _kind(definition: Any) -> tuple[str, int]:
    """Return the type and the length of a field (-1: single value, 0: variable length)."""
    kind, inner = definition
    if kind.name == "ARRAY":
        return _kind(inner[0])[0], inner[1]
    if kind.name == "SEQUENCE":
        return _kind(inner[0])[0], 0
    return (inner, -1) if kind.name == "NAME" else (inner[0], -1)


def _example(type_: str, length: int) -> str:
    if length >= 0:
        return "[]"
    return "{}" if "/" in type_ else "" if type_ == "string" else "False" if type_ == "bool" else "0"
