"""`Commands`: what ROS programs may send, and the requests to the loop that it becomes."""

from __future__ import annotations

import json
import math
import reprlib
from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
import numpy as np

from armlab.bridge.control.limits import joint_name
from armlab.bridge.servers.messages import CommandRequest, Request, SetRequest, Stop
from armlab.errors import CommandRefused
from armlab.robots import Robot

__all__ = ["Commands"]

_KINDS = {"position": "q", "velocity": "qd", "effort": "tau"}
_SPELLINGS = ("command", "commands")  # of ROS 1 and of ROS 2
_NUMBERS, _TEXT, _EMPTY = "std_msgs/msg/Float64MultiArray", "std_msgs/msg/String", "std_msgs/msg/Empty"
_LONGEST = 65536  # characters of a text
_NUMERIC = {int, float, type(None)}  # not bool, which is an int; null is a number that is not finite


class Commands:
    """The topics that are listened to."""

    def __init__(self, cell: str, robots: Mapping[str, Robot]) -> None:
        self._robots = dict(robots)
        self._orders: dict[str, tuple[str, tuple[str, ...]]] = {}
        groups: dict[str, tuple[str, ...]] = {f"/{name}": (name,) for name in robots}
        both = sorted(robots, key=lambda name: robots[name].side)  # "left" comes before "right"
        if [robots[name].side for name in both] == ["left", "right"]:
            groups[f"/{cell}"] = tuple(both)
        for prefix, names in groups.items():
            for kind, field in _KINDS.items():
                for spelling in _SPELLINGS:
                    self._orders[f"{prefix}/joint_group_{kind}_controller/{spelling}"] = field, names
        self._settings = {f"/{name}/set_parameter" for name in robots}
        self._stops = {f"/{name}/stop" for name in robots}
        self.types = dict.fromkeys(self._orders, _NUMBERS)
        self.types |= dict.fromkeys(self._settings, _TEXT) | dict.fromkeys(self._stops, _EMPTY)

    def requests(self, topic: str, content: Any, client: str) -> list[Request]:
        """Return what a message asks the loop for."""
        if topic in self._stops:
            return [Stop(client)]
        if topic in self._settings:
            return [SetRequest(client, _settings(topic, content))]
        field, names = self._orders[topic]
        values = _numbers(topic, content, [self._robots[name] for name in names])
        found: list[Request] = []
        first = 0
        for name in names:
            end = first + self._robots[name].n
            request = CommandRequest(client, name, first=first)
            found.append(msgspec.structs.replace(request, **{field: values[first:end]}))
            first = end
        return found


def _numbers(topic: str, content: Any, arms: Sequence[Robot]) -> list[float]:
    count = sum(arm.n for arm in arms)
    given = content.tolist() if isinstance(content, np.ndarray) else content
    try:
        if not isinstance(given, list | tuple) or not {type(value) for value in given} <= _NUMERIC:
            raise TypeError
        values = [math.nan if value is None else float(value) for value in given]
    except (TypeError, OverflowError):
        raise CommandRefused(f"Expected {count} numbers on {topic}, got {reprlib.repr(given)}.") from None
    if len(values) != count:
        raise CommandRefused(f"Expected {count} numbers on {topic}, got {len(values)}.")
    bad = [k for k, value in enumerate(values) if not math.isfinite(value)]
    if bad:
        firsts = np.cumsum([0, *(arm.n for arm in arms)]).tolist()
        joints = [joint_name(arm, i, first) for arm, first in zip(arms, firsts, strict=False) for i in range(arm.n)]
        raise CommandRefused(f"Expected finite numbers on {topic}, got {values[bad[0]]} for {joints[bad[0]]}.")
    return values


def _settings(topic: str, content: Any) -> dict[str, Any]:
    if not isinstance(content, str) or len(content) > _LONGEST:
        raise CommandRefused(f"Expected a text of at most {_LONGEST} characters on {topic}.")
    try:
        values = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise CommandRefused(f'Expected JSON such as {{"gain": 2.0}} on {topic}, but {error}.') from None
    if not isinstance(values, dict) or not values:
        raise CommandRefused(f'Expected values by name such as {{"gain": 2.0}} on {topic}, got {content[:80]!r}.')
    return values
