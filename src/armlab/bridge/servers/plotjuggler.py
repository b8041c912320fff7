"""PlotJuggler server: one JSON datagram per row (`Datagrams`), and the process that sends them."""

from __future__ import annotations

import ipaddress
import math
import socket
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import msgspec

from armlab.bridge.servers.messages import Listening
from armlab.bridge.servers.row import RowField, RowSchema, places, read_head
from armlab.bridge.servers.server_end import LoopEnd
from armlab.errors import ConfigError, UnknownName

_FIELDS = ("q", "qd", "tau", "wrench", "wrench_hat", "q_sent", "qd_sent", "tau_sent", "q_ref", "qd_ref", "tau_ref")
_LARGEST = 1400  # maximum datagram size in bytes for other computers: one network packet
_LARGEST_HERE = 65507
_NUMBER = len("-1234567890123456789012.0")  # the longest number; "-1.2345678901234567e-308" is one character shorter
_STAMP = len('{"timestamp":1700000000.1234567}')


class Datagrams:
    """JSON encoder for rows; `fields` lists the encoded fields, which fit into `largest` bytes."""

    def __init__(self, schema: RowSchema, fields: Sequence[str] | None = None, largest: int = _LARGEST) -> None:
        self._schema = schema
        known = {name.partition(".")[2] for name, field in schema.fields.items() if field.type != "text"}
        for name in fields or ():
            if name not in known:
                raise UnknownName.among("field of rows", name, known)
        others = [one for one in schema.fields.values() if one.source not in schema.robots]
        sizes = dict.fromkeys(schema.robots, _STAMP + sum(_size(one, len(one.source)) for one in others))
        self.fields: list[str] = []
        for name in fields or _FIELDS:
            found = {robot: schema.fields.get(f"{robot}.{name}") for robot in schema.robots}
            more = {robot: 0 if one is None else _size(one, len(robot)) for robot, one in found.items()}
            if max(sizes[robot] + more[robot] for robot in sizes) <= largest:
                sizes = {robot: sizes[robot] + more[robot] for robot in sizes}
                self.fields.append(name)
            elif fields:
                raise ConfigError(
                    f"Expected fields that fit into {largest} bytes for PlotJuggler on another computer, but {name} "
                    "does not fit. Choose fewer fields."
                )
        self._parts = {robot: _FieldGroup(schema, robot, self.fields) for robot in schema.robots}
        self._sources = {one.source: _FieldGroup(schema, one.source) for one in others}
        self._fresh = [(robot, schema.fields[f"{robot}.fresh"].offset) for robot in schema.robots]

    def datagram(self, data: bytes) -> bytes:
        """Return the datagram for a row, with the values of all sources and of the arms that the row updates."""
        _, _, wall_ns = read_head(self._schema, data)
        found: dict[str, Any] = {"timestamp": 1e-9 * wall_ns}
        for robot, place in self._fresh:
            if any(data[place : place + 8]):
                found[robot] = self._parts[robot].values(data)
        for source, part in self._sources.items():
            found[source] = part.values(data)
        return msgspec.json.encode(found)


class _FieldGroup:
    """Fields of an arm or a source in a datagram; array elements are numbered from 1."""

    def __init__(self, schema: RowSchema, source: str, names: Iterable[str] | None = None) -> None:
        known = places(schema, source)
        self._fields = [
            (name, *known[name], bool(schema.fields[f"{source}.{name}"].shape))
            for name in names or known
            if name in known
        ]

    def values(self, data: bytes) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for name, form, offset, is_array in self._fields:
            values = form.unpack_from(data, offset)
            found[name] = {str(k): value for k, value in enumerate(values, 1)} if is_array else values[0]
        return found


class PlotJugglerServer:
    """PlotJuggler server process, which sends datagrams until the loop closes the feed."""

    def __init__(self, feed: socket.socket, options: Mapping[str, Any]) -> None:
        to, self._from = options["to"], options["host"]
        self._to, self._sent, self._lost = (to, options["port"]), 0, 0
        try:
            is_here = ipaddress.IPv4Address(to).is_loopback
        except ValueError:
            raise ConfigError(f"Expected an IPv4 address for the option `to` of plotjuggler, got {to}.") from None
        if not is_here and ipaddress.IPv4Address(self._from).is_loopback:
            raise ConfigError(
                f"Expected --listen plotjuggler=ADDRESS, because {to} is not a loopback address. Add this option."
            )
        self._loop = LoopEnd(feed, lambda: {"{}:{}".format(*self._to): (self._sent, self._lost)})
        self._datagrams = Datagrams(self._loop.schema, options["fields"], _LARGEST_HERE if is_here else _LARGEST)

    def run(self) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            out.bind((self._from, 0))
            out.setblocking(False)
            out.connect(self._to)  # connected, so the operating system reports a missing receiver
            to, fields = "{}:{}".format(*self._to), ", ".join(self._datagrams.fields)
            self._loop.ask(Listening(where=[f"to {to} (plotjuggler: {fields})"]))
            while (messages := self._loop.receive(None)) is not None:
                for row in (one for one in messages if isinstance(one, bytes)):
                    try:
                        out.send(self._datagrams.datagram(row))
                        self._sent += 1
                    except OSError:  # no receiver
                        self._lost += 1


def _size(field: RowField, owner: int) -> int:
    """Return the maximum size of a field in bytes, including its own name and the name of its owner."""
    count = math.prod(field.shape)
    return len(field.name) + owner + 16 + count * (_NUMBER + len(str(count)) + 4)
