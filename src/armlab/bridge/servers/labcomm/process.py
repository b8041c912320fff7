"""`LabCommProcess`: LabComm server process between the loop's feed (see `servers.hub`) and its clients.

The process has one thread, because passing a row to another thread takes longer than handling it.
"""

from __future__ import annotations

import logging
import math
import socket
from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from armlab.bridge.servers.labcomm.channels import (
    ArmChannel,
    Channel,
    FusedArm,
    FusedChannel,
    FusedSource,
    ParameterChannel,
    Value,
)
from armlab.bridge.servers.labcomm.rows import Order, Row
from armlab.bridge.servers.labcomm.server import Ports
from armlab.bridge.servers.messages import CommandRequest, Leave, Listening, Report, SetRequest, Stop
from armlab.bridge.servers.row import clock_ms, read_row
from armlab.bridge.servers.server_end import LoopEnd
from armlab.errors import ConfigError
from armlab.robots import Robot


def arm_in(values: Mapping[str, Any], name: str) -> FusedArm | None:
    """Return an arm's part of a loop row, or None before the first packet or if the clock of the arm is invalid."""
    tm = clock_ms(values[f"{name}.robot_ns"], values[f"{name}.session_t"])
    if tm is None or not math.isfinite(values[f"{name}.age"]):
        return None
    row = Row(tm, *(values[f"{name}.{part}"] for part in ("q", "qd", "tau")))
    return FusedArm(name, values[f"{name}.receive_ns"] // 1000, row)


def source_in(values: Mapping[str, Any], name: str, fields: Sequence[str], now_ns: int) -> FusedSource | None:
    """Return the last values of a source, or None before the first values have arrived."""
    age_ns = 1e9 * values[f"{name}.age"]
    if not math.isfinite(age_ns):
        return None
    numbers = np.concatenate([np.ravel(values[field]) for field in fields]).tolist()
    return FusedSource(name, (now_ns - round(age_ns)) // 1000, numbers)


_LEFT, _PARAMETERS, _FUSED = 7511, 7513, 7514
_ROWS = 64  # maximum number of rows sent before the clients are served again
_logger = logging.getLogger("armlab.bridge")


def labcomm_options(
    robots: Sequence[Robot],
    host: str = "127.0.0.1",
    ports: Sequence[int] | None = None,
    dialect: str = "2014v1",
    order: Order = "abb",
    parameters: int | None = _PARAMETERS,
    fused: int | None = _FUSED,
    types: str | None = None,
    follows_client: bool = False,
) -> dict[str, Any]:
    """Return the options of a server for these arms; default ports: 7511 (left or single arm) and 7512 (right)."""
    for robot in robots:
        ArmChannel(robot.name, 0, None, robot.abb_axes, order, types, dialect)  # detects invalid options early
    if ports is None:
        sides = [robot.side for robot in robots]
        ports = [_LEFT + (side == "right" if all(sides) else k) for k, side in enumerate(sides)]
    if len(ports) != len(robots):
        raise ConfigError(f"Expected a LabComm port for each of {len(robots)} arms, got {len(ports)}.")
    arms = {one.name: {"port": port, "axes": list(one.abb_axes)} for one, port in zip(robots, ports, strict=True)}
    if any(robot.n != 7 for robot in robots):
        fused = None
    return {
        "host": host,
        "dialect": dialect,
        "order": order,
        "arms": arms,
        "parameters": parameters,
        "fused": fused,
        "types": types,
        "follows_client": follows_client,
    }


class LabCommProcess:
    """LabComm server process, which runs until the loop closes the socket."""

    def __init__(self, feed: socket.socket, options: Mapping[str, Any]) -> None:
        self._options = options
        self._commands: dict[tuple[str, str], CommandRequest] = {}  # newest per turn; older commands have no effect
        self._loop = LoopEnd(feed, lambda: self._ports.clients)
        self._sequences = self._set_sequences()
        schema, self._sources = self._loop.schema, defaultdict[str, list[str]](list)
        for field in schema.fields.values():
            if field.source not in schema.robots and field.name != f"{field.source}.age":
                self._sources[field.source].append(field.name)
        self._ports = Ports(self._channels(), options["host"], self._event, self._stop, feed)

    def run(self) -> None:
        host, ports = self._options["host"], self._ports
        self._loop.ask(Listening(where=[f"{host}:{port} (labcomm, {name})" for name, port in ports.numbers.items()]))
        try:
            while self._take():
                ports.turn()
                for request in self._commands.values():
                    self._loop.ask(request)
                self._commands.clear()
        finally:
            ports.close()

    def _take(self) -> bool:
        """Handle a limited number of messages from the loop; return False once the loop has ended."""
        for _ in range(_ROWS):
            messages = self._loop.receive()
            if messages is None:
                return False
            for message in messages:
                if isinstance(message, bytes):
                    self._row(message)
                else:
                    self._text(message)
            if not messages:
                break
        return True

    def _left(self, client: str) -> None:
        for arm in self._options["arms"]:
            self._commands.pop((arm, client), None)
        self._loop.ask(Leave(client))

    def _stop(self, client: str) -> None:
        self._loop.ask(Stop(client))

    def _channels(self) -> list[Channel]:
        options = self._options
        common = {name: options[name] for name in ("dialect", "follows_client")}
        channels: list[Channel] = []
        for name, arm in options["arms"].items():
            where = name, arm["port"], self._command, arm["axes"], options["order"], options["types"]
            channels.append(ArmChannel(*where, **common, on_left=self._left))
        if options["fused"] is not None:
            axes = next(iter(options["arms"].values()))["axes"]
            channels.append(FusedChannel(options["fused"], axes, options["order"], **common))
        if options["parameters"] is not None:
            values = {name: self._value(name) for name in self._loop.parameters}
            channels.append(ParameterChannel(values, options["parameters"], self._set, **common))
        return channels

    def _command(self, name: str, row: Row, client: str) -> None:
        q, qd, tau = (None if part is None else part.tolist() for part in (row.q, row.qd, row.tau))
        by_axis = self._options["order"] == "abb"
        self._commands[name, client] = CommandRequest(client, name, q, qd, tau, by_axis=by_axis)

    def _set(self, name: str, value: Any, client: str) -> None:
        """Request a parameter value; the loop replies with the current values or with a refusal."""
        if self._loop.parameters[name]["type"] == "int" and float(value).is_integer():
            value = int(value)
        self._loop.ask(SetRequest(client, {name: value}))

    def _value(self, name: str) -> Value:
        """Return a parameter value for LabComm, in which every number is a double."""
        value = self._loop.parameters[name]["value"]
        if isinstance(value, list):
            return [float(one) for one in value]
        return value if isinstance(value, bool | str) else float(value)

    def _set_sequences(self) -> dict[str, int]:
        return {name: about["sequence"] for name, about in self._loop.parameters.items()}

    def _text(self, message: Mapping[str, Any]) -> None:
        if message["kind"] == "parameters":
            before, self._sequences = self._sequences, self._set_sequences()
            for name, sequence in self._sequences.items():
                if before.get(name) != sequence:
                    self._echo(name)
        elif message["kind"] == "answer":
            for name in message["refused"]:  # the client's value did not take effect
                self._echo(name)

    def _echo(self, name: str) -> None:
        if "parameters" in self._ports.numbers:
            self._ports.put("parameters", (name, self._value(name)))

    def _row(self, data: bytes) -> None:
        ports, pace = self._ports, next(iter(self._options["arms"]))
        _, _, wall_ns, values = read_row(self._loop.schema, data)
        held = [one for name in self._options["arms"] if (one := arm_in(values, name)) is not None]
        for arm in held:
            if not values[f"{arm.name}.fresh"]:
                continue
            if ports.has_clients(arm.name):
                ports.put(arm.name, arm.row)
            if arm.name == pace and ports.has_clients("fused"):
                found = (source_in(values, name, fields, wall_ns) for name, fields in self._sources.items())
                ports.put("fused", (wall_ns // 1000, held, [one for one in found if one is not None]))

    def _event(self, text: str, warn: bool = False, each: bool = False) -> None:
        if warn:
            self._loop.ask(Report(text=text))
        else:
            _logger.info("labcomm %s", text)
