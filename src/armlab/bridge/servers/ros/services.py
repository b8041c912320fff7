"""Services of ROS nodes for all transports: `Service`, service types, and the parameter services."""

from __future__ import annotations

import math
import re
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import get_types_from_msg

from armlab.bridge.servers.messages import SetRequest
from armlab.bridge.servers.ros.topics import store
from armlab.bridge.servers.server_end import LoopEnd
from armlab.errors import CommandRefused, UnknownName

Respond = Callable[[Any], None]
"""Function that sends the response to a request (a message of a type in `store`); thread-safe."""


@dataclass(frozen=True)
class Service:
    """Service: full name, ROS 2 type, and the function that answers a client's request."""

    name: str
    type: str
    answer: Callable[[Any, str, Respond], None]

    @property
    def request(self) -> str:
        """Request type of the service."""
        return f"{self.type}_Request"

    @property
    def response(self) -> str:
        """Response type of the service."""
        return f"{self.type}_Response"

    def take(self, cdr: bytes, client: str, send: Callable[[bytes], None]) -> None:
        """Answer a serialised request; `send` receives the serialised response."""
        try:
            request = store().deserialize_cdr(cdr, self.request)
        except Exception as error:  # the codec's exceptions for invalid bytes are undocumented
            raise CommandRefused(
                f"Expected a request of {self.name}, got {len(cdr)} invalid bytes ({error})."
            ) from None
        self.answer(request, client, lambda response: send(bytes(store().serialize_cdr(response, self.response))))


def register(types: Mapping[str, tuple[str, str]]) -> None:
    """Register service types in `store`: names, such as "std_srvs/srv/Empty", with request and response fields."""
    # The service type itself is never sent, but its hash is part of keys and tokens.
    found: Any = get_types_from_msg(_INFO, "service_msgs/msg/ServiceEventInfo")
    for name, texts in types.items():
        request, response, event = ((Nodetype.NAME, f"{name}_{part}") for part in ("Request", "Response", "Event"))
        for (_, part), text in zip((request, response), texts, strict=True):
            (found[part],) = get_types_from_msg(text, part).values()
        found[event[1]] = (
            [],
            [
                ("info", (Nodetype.NAME, "service_msgs/msg/ServiceEventInfo")),
                *(
                    (label, (Nodetype.SEQUENCE, (one, 1)))
                    for label, one in (("request", request), ("response", response))
                ),
            ],
        )
        labels = ("request_message", "response_message", "event_message")
        found[name] = [], list(zip(labels, (request, response, event), strict=True))
    store().register(found)


_INFO = "uint8 event_type\nbuiltin_interfaces/Time stamp\nuint8[16] client_gid\nint64 sequence_number"


_ANSWER = 1_000_000_000  # ns for the loop to answer a parameter setting
_SETTINGS = 64  # maximum number of pending requests to set parameters per client; more are treated as a flood


@dataclass(eq=False)
class _Setting:
    """Values that a client sets together; `sequence` is None until they have been sent to the loop."""

    client: str
    values: dict[str, Any]
    done: Callable[[str], None]  # called with "" or the reason for refusal
    until_ns: int
    sequence: int | None = None


class Settings:
    """Parameter settings of all clients; a setting waits for earlier settings of the same parameters.

    The loop's answers identify the client and the parameters, but not the call. Clients are answered without holding
    the lock, because a transport has its own lock.
    """

    def __init__(self, loop: LoopEnd) -> None:
        self._loop = loop
        self._waiting: list[_Setting] = []
        self._settled: list[Callable[[], None]] = []
        self._lock = threading.Lock()

    @contextmanager
    def _settling(self) -> Iterator[None]:
        """Hold the lock, send the ready settings to the loop, then answer the completed requests."""
        with self._lock:
            yield
            self._ask()
            settled, self._settled = self._settled, []
        for answer in settled:
            answer()

    def set(self, client: str, values: dict[str, Any], done: Callable[[str], None], now_ns: int) -> None:
        """Set several parameters together; may be called from any thread."""
        with self._settling():
            unknown = next((name for name in values if name not in self._loop.parameters), None)
            if unknown is not None:
                why = str(UnknownName.among("parameter", unknown[:80], self._loop.parameters))
                self._settled.append(partial(done, why))
            elif sum(one.client == client for one in self._waiting) >= _SETTINGS:
                self._settled.append(
                    partial(done, f"Expected at most {_SETTINGS} pending requests to set parameters. Send fewer.")
                )
            else:
                self._waiting.append(_Setting(client, values, done, now_ns + _ANSWER))

    def confirm(self) -> None:
        """Confirm applied settings to their clients."""
        with self._settling():
            for one in [one for one in self._waiting if one.sequence is not None]:
                about = self._loop.parameters[next(iter(one.values))]
                if about["sequence"] > (one.sequence or 0) and about["who"].partition(" ")[2] == one.client:
                    self._settle(one, "")

    def refuse(self, message: Mapping[str, Any]) -> bool:
        """Answer a settings request that the loop refused; return False if the message is not a reply to such a
        request."""
        with self._settling():
            asked = [one for one in self._waiting if one.sequence is not None and one.client == message["client"]]
            refused = next((one for one in asked if not one.values.keys().isdisjoint(message["refused"])), None)
            if refused is not None:
                self._settle(refused, message["text"])
        return refused is not None

    def tick(self, now_ns: int) -> None:
        """Reply to parameter settings that the loop did not answer in time."""
        with self._settling():
            for one in [one for one in self._waiting if now_ns > one.until_ns]:
                known = {name: self._loop.parameters[name] for name in one.values}
                values = [f"{name} = {it['value']!r}, set by {it['who'] or 'default'}" for name, it in known.items()]
                why = f"Expected the loop to set {', '.join(known)} within 1 s, got no answer."
                self._settle(one, f"{why} Current values: {'; '.join(values)}.")

    def _ask(self) -> None:
        """Send each waiting settings request that shares no parameter with an earlier request."""
        taken: set[str] = set()
        for one in list(self._waiting):
            if one.sequence is None and taken.isdisjoint(one.values):
                one.sequence = self._loop.parameters[next(iter(one.values))]["sequence"]
                try:
                    self._loop.ask(SetRequest(one.client, one.values))
                except CommandRefused as error:
                    self._settle(one, str(error))
                    continue
            taken.update(one.values)

    def _settle(self, one: _Setting, why: str) -> None:
        self._waiting.remove(one)
        self._settled.append(partial(one.done, why))


_PARAMETERS = {
    "list_parameters": ("ListParameters", "string[] prefixes\nuint64 depth", "ListParametersResult result"),
    "get_parameters": ("GetParameters", "string[] names", "ParameterValue[] values"),
    "get_parameter_types": ("GetParameterTypes", "string[] names", "uint8[] types"),
    "describe_parameters": ("DescribeParameters", "string[] names", "ParameterDescriptor[] descriptors"),
    "set_parameters": ("SetParameters", "Parameter[] parameters", "SetParametersResult[] results"),
    "set_parameters_atomically": ("SetParametersAtomically", "Parameter[] parameters", "SetParametersResult result"),
}
_VALUES = (
    "bool",
    "integer",
    "double",
    "string",
    *(f"{kind}_array" for kind in ("byte", "bool", "integer", "double", "string")),
)
_KINDS = {"bool": 1, "int": 2, "float": 3, "text": 4}
_VECTOR = 8
_EMPTY = (0, False, 0, 0.0, "", [], [], [], [], [])


def parameter_services(node: str, loop: LoopEnd, settings: Settings) -> list[Service]:
    """Return the services of a node for the parameters of the cell."""
    register(
        {
            f"rcl_interfaces/srv/{name}": (_local(request), _local(response))
            for name, request, response in _PARAMETERS.values()
        }
    )
    made = _ParameterServices(loop, settings)
    return [
        Service(f"/{node}/{name}", f"rcl_interfaces/srv/{type_}", getattr(made, name))
        for name, (type_, *_) in _PARAMETERS.items()
    ]


def _local(text: str) -> str:
    """Prefix the message types of a definition with rcl_interfaces."""
    return re.sub(r"^(?=[A-Z])", "rcl_interfaces/", text)


def _made(name: str, *fields: Any) -> Any:
    return store().types[f"rcl_interfaces/{name}"](*fields)


class _ParameterServices:
    """Implementation of the parameter services; unknown parameters have the type "not set", as in rclpy."""

    def __init__(self, loop: LoopEnd, settings: Settings) -> None:
        self._loop, self._settings = loop, settings

    def list_parameters(self, request: Any, client: str, respond: Respond) -> None:
        names = [
            name
            for name in self._loop.parameters
            if not request.prefixes or any(name == one or name.startswith(f"{one}.") for one in request.prefixes)
        ]
        respond(_made("srv/ListParameters_Response", _made("msg/ListParametersResult", names, [])))

    def get_parameters(self, request: Any, client: str, respond: Respond) -> None:
        respond(_made("srv/GetParameters_Response", [self._value(name) for name in request.names]))

    def get_parameter_types(self, request: Any, client: str, respond: Respond) -> None:
        kinds = np.array([self._kind(name) for name in request.names], dtype=np.uint8)
        respond(_made("srv/GetParameterTypes_Response", kinds))

    def describe_parameters(self, request: Any, client: str, respond: Respond) -> None:
        respond(_made("srv/DescribeParameters_Response", [self._descriptor(name) for name in request.names]))

    def set_parameters(self, request: Any, client: str, respond: Respond) -> None:
        results: list[Any] = [None] * len(request.parameters)
        left, lock = len(results), threading.Lock()

        def done(k: int, why: str) -> None:
            nonlocal left
            with lock:
                results[k] = _made("msg/SetParametersResult", not why, why)
                left -= 1
                is_whole = not left
            if is_whole:
                respond(_made("srv/SetParameters_Response", results))

        if not results:
            respond(_made("srv/SetParameters_Response", []))
        for k, one in enumerate(request.parameters):
            self._set(client, [one], partial(done, k))

    def set_parameters_atomically(self, request: Any, client: str, respond: Respond) -> None:
        def done(why: str) -> None:
            respond(_made("srv/SetParametersAtomically_Response", _made("msg/SetParametersResult", not why, why)))

        if request.parameters:
            self._set(client, request.parameters, done)
        else:
            done("")

    def _set(self, client: str, parameters: Iterable[Any], done: Callable[[str], None]) -> None:
        try:
            values = {one.name: _plain(one) for one in parameters}
        except CommandRefused as error:
            done(str(error))
        else:
            self._settings.set(client, values, done, time.monotonic_ns())

    def _kind(self, name: str) -> int:
        about = self._loop.parameters.get(name)
        return 0 if about is None else _KINDS.get(about["type"], _VECTOR)

    def _value(self, name: str) -> Any:
        fields, kind = list[Any](_EMPTY), self._kind(name)
        fields[5:9] = [np.array([], dtype) for dtype in (np.uint8, bool, np.int64, float)]
        if kind:
            value = self._loop.parameters[name]["value"]
            fields[0], fields[kind] = kind, np.array(value, dtype=float) if kind == _VECTOR else value
        return _made("msg/ParameterValue", *fields)

    def _descriptor(self, name: str) -> Any:
        about, kind = self._loop.parameters.get(name), self._kind(name)
        if about is None:
            return _made("msg/ParameterDescriptor", name, 0, "", "", False, False, [], [])
        unit = f" [{about['unit']}]" if about["unit"] else ""
        bounds = [-math.inf if about["minimum"] is None else about["minimum"]]
        bounds.append(math.inf if about["maximum"] is None else about["maximum"])
        reals, integers = [], []
        if kind in (_KINDS["float"], _VECTOR) and np.isfinite(bounds).any():
            reals = [_made("msg/FloatingPointRange", *bounds, 0.0)]
        elif kind == _KINDS["int"] and np.isfinite(bounds).any():
            low, high = (int(np.clip(one, -(2**53), 2**53)) for one in bounds)
            integers = [_made("msg/IntegerRange", low, high, 1)]
        who = (
            "Any client may set this parameter."
            if about["rights"] == "anyone"
            else "Only the commander of an arm may set this parameter."
        )
        text = f"{about['text']}{unit}".strip()
        return _made("msg/ParameterDescriptor", name, kind, text, who, not about["live"], False, reals, integers)


def _plain(parameter: Any) -> Any:
    """Return the value of an rcl_interfaces/msg/Parameter."""
    name, kind = parameter.name, parameter.value.type
    if not 0 < kind <= len(_VALUES):
        raise CommandRefused(f"Expected a value for {name[:80]}, because declared parameters cannot be deleted.")
    value = getattr(parameter.value, f"{_VALUES[kind - 1]}_value")
    value = value.tolist() if isinstance(value, np.ndarray) else value
    for one in value if isinstance(value, list) else [value]:
        if isinstance(one, float) and not math.isfinite(one):
            raise CommandRefused(f"Expected finite numbers for {name[:80]}, got {one}. The value is unchanged.")
    return value
