"""`Rosapi`: the services by which a client finds out what there is; names and answers are those of rosapi."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from typing import Any

from armlab.bridge.servers.ros.topics import store
from armlab.bridge.servers.rosbridge.protocol import HEADER, TIME, Dialect, fields, full_name, read_type, type_name
from armlab.errors import CommandRefused, UnknownName

__all__ = ["SET_PARAM", "Rosapi", "parameter_name"]

SET_PARAM = "/rosapi/set_param"

Arguments = Mapping[str, Any]


def parameter_name(arguments: Arguments, known: Mapping[str, Any]) -> str:
    """Return the parameter that a client means by "gain", "/gain" or "/node:gain"."""
    name = arguments.get("name")
    found = name.rpartition(":")[2].lstrip("/") if isinstance(name, str) else ""
    if found not in known:
        raise UnknownName.among("parameter", str(name)[:80], known)
    return found


class Rosapi:
    """Answers at once whatever needs no loop."""

    def __init__(
        self, cell: str, topics: Mapping[str, str], parameters: Callable[[], Mapping[str, Mapping[str, Any]]]
    ) -> None:
        self._cell, self._topics, self._parameters = cell, dict(topics), parameters
        self._made: dict[str, tuple[str, tuple[str, ...], Callable[[Arguments, Dialect], dict[str, Any]]]] = {
            "topics": ("Topics", (), self._all_topics),
            "topic_type": ("TopicType", ("topic",), self._topic_type),
            "topics_for_type": ("TopicsForType", ("type",), self._topics_for_type),
            "services": ("Services", (), lambda given, dialect: {"services": list(self.services)}),
            "service_type": ("ServiceType", ("service",), self._service_type),
            "nodes": ("Nodes", (), lambda given, dialect: {"nodes": [f"/{self._cell}"]}),
            "get_time": ("GetTime", (), _time),
            "message_details": ("MessageDetails", ("type",), _details),
            "get_param_names": ("GetParamNames", (), lambda given, dialect: {"names": list(self._parameters())}),
            "get_param": ("GetParam", ("name", "default"), self._get_param),
            "has_param": ("HasParam", ("name",), self._has_param),
            "delete_param": ("DeleteParam", ("name",), _refuse_to_delete),
            "set_param": ("SetParam", ("name", "value"), lambda given, dialect: {}),  # by the loop: see `Engine`
        }
        self.services = tuple(f"/rosapi/{name}" for name in self._made)

    def arguments(self, service: str, given: dict[str, Any] | list[Any] | None) -> Arguments:
        """Return the arguments of a call by name."""
        full = full_name(service)
        if full not in self.services:
            raise UnknownName.among("service", service[:80], self.services)
        names = self._made[full.removeprefix("/rosapi/")][1]
        return dict(zip(names, given)) if isinstance(given, list) else given or {}

    def answer(self, service: str, arguments: Arguments, dialect: Dialect) -> dict[str, Any]:
        """Return the values that a service answers with."""
        return self._made[full_name(service).removeprefix("/rosapi/")][2](arguments, dialect)

    def _all_topics(self, given: Arguments, dialect: Dialect) -> dict[str, Any]:
        types = [type_name(type_, dialect) for type_ in self._topics.values()]
        return {"topics": list(self._topics), "types": types}

    def _topic_type(self, given: Arguments, dialect: Dialect) -> dict[str, Any]:
        type_ = self._topics.get(full_name(_text(given, "topic")))
        return {"type": "" if type_ is None else type_name(type_, dialect)}

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
        raise CommandRefused(f"Expected {name!r} as a text, got {str(found)[:80]!r}.")
    return found


def _time(given: Arguments, dialect: Dialect) -> dict[str, Any]:
    seconds, ns = divmod(time.time_ns(), 1_000_000_000)
    names = ("secs", "nsecs") if dialect == "ros1" else ("sec", "nanosec")
    return {"time": dict(zip(names, (seconds, ns)))}


def _refuse_to_delete(given: Arguments, dialect: Dialect) -> dict[str, Any]:
    raise CommandRefused("Expected a parameter to be set or read: those of a cell are declared and stay.")


def _details(given: Arguments, dialect: Dialect) -> dict[str, Any]:
    """Return the fields of a type and of those in it, in the dialect of its text."""
    type_, spoken = read_type(_text(given, "type"))
    known = store().fielddefs
    if type_ not in known:
        raise CommandRefused(f"Expected a type that the topics here have, got {type_[:80]!r}. Ask /rosapi/topics.")
    found: list[dict[str, Any]] = []
    waiting, seen = [type_], {type_}
    while waiting:
        one = waiting.pop(0)
        parts = _parts(one, spoken)
        found.append(
            {
                "type": type_name(one, spoken),
                "fieldnames": list(parts),
                "fieldtypes": [type_name(part, spoken) for part, _ in parts.values()],
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


def _parts(type_: str, dialect: Dialect) -> dict[str, tuple[str, int]]:
    """Return type and length of the fields of a message, by name."""
    shapes = dict(store().fielddefs[type_][1])
    found = {name: _shape(shapes[name]) for name in fields(type_)}
    if dialect == "ros1":
        found = {name: ("time" if part == TIME else part, length) for name, (part, length) in found.items()}
    return {"seq": ("uint32", -1), **found} if dialect == "ros1" and type_ == HEADER else found


def _shape(definition: Any) -> tuple[str, int]:
    """Return the type of a field, and its length: -1 for one value, 0 for any number."""
    kind, inner = definition
    if kind.name == "ARRAY":
        return _shape(inner[0])[0], inner[1]
    if kind.name == "SEQUENCE":
        return _shape(inner[0])[0], 0
    return (inner, -1) if kind.name == "NAME" else (inner[0], -1)


def _example(type_: str, length: int) -> str:
    if length >= 0:
        return "[]"
    return "{}" if "/" in type_ else "" if type_ == "string" else "False" if type_ == "bool" else "0"
