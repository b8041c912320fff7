"""`ZenohProcess`: native Zenoh server process between the loop and programs on other computers."""

from __future__ import annotations

import contextlib
import json
import math
import socket
import struct
from collections.abc import Mapping
from functools import partial
from typing import Any

import msgspec
import numpy as np

from armlab.bridge.servers.messages import CommandRequest, Listening, Report, Request, SetRequest, Stop
from armlab.bridge.servers.row import MONO, Pace
from armlab.bridge.servers.server_end import LoopEnd
from armlab.bridge.servers.status import Status
from armlab.bridge.servers.zenoh.messages import COMMANDS, Attachment, checksum, data_of, key
from armlab.bridge.servers.zenoh.security import Security
from armlab.bridge.servers.zenoh.session import BlockingPublisher, Publisher, close_session, open_near
from armlab.errors import CommandRefused

_VIEW = 33_000_000  # ns between rows on the key "view"
_STATUS = 500_000_000  # ns between status messages
_LONGEST = 65536  # maximum size of a setting in bytes
_MOST = 64  # maximum number of joints
_CLIENTS = 256  # maximum number of clients whose robot is stored for addressing answers
_MONO = struct.Struct("<q")
_UNKNOWN = "unknown"


class ZenohProcess:
    """Zenoh server process, which runs until the loop closes the socket."""

    def __init__(self, feed: socket.socket, options: Mapping[str, Any]) -> None:
        self._loop = LoopEnd(feed, self._counts)
        self._lab = options["lab"]
        self._arms = {name: _ArmOutput(self._loop, name) for name in self._loop.schema.robots}
        self._recording: dict[str, Any] = {}
        self._answers: dict[str, str] = {}  # client -> robot in the key of the answers
        self._declared: list[Any] = []  # deleting the last reference to an object undeclares it
        commands = "zenoh" in self._loop.about.get("commands", ())
        self._session, self._where = open_near(
            options["host"], options["port"], options.get("router", ""), Security.of(options), commands
        )

    def run(self) -> None:
        try:
            for arm in self._arms.values():
                self._declare(arm)
            self._loop.ask(Listening(where=[f"{self._where}, armlab/{self._lab}"]))
            while (messages := self._loop.receive(None)) is not None:
                for message in messages:
                    if isinstance(message, bytes):
                        self._row(message)
                    else:
                        self._text(message)
        finally:
            for arm in self._arms.values():
                arm.close()
            close_session(self._session)

    def _counts(self) -> dict[str, tuple[int, int]]:
        """Return the numbers of rows sent and dropped, by key."""
        rows = {f"{name} {what}": arm.rows.get(what) for name, arm in self._arms.items() for what in _ArmOutput.KINDS}
        return {name: (one.sent, one.dropped) for name, one in rows.items() if one is not None and one.sent}

    def _declare(self, arm: _ArmOutput) -> None:
        session, lab = self._session, self._lab
        arm.open(session, lab)
        self._declared += [
            session.declare_subscriber(key(lab, arm.name, "command/*"), partial(self._command, arm.name)),
            session.declare_subscriber(key(lab, arm.name, "param/*"), partial(self._set, arm.name)),
            session.declare_subscriber(key(lab, arm.name, "stop"), partial(self._stop, arm.name)),
            session.declare_queryable(key(lab, arm.name, "schema"), partial(self._schema, arm.name)),
            session.declare_queryable(key(lab, arm.name, "about"), partial(self._about, arm.name)),
            session.declare_queryable(key(lab, arm.name, "param/*"), partial(self._value, arm.name)),
            session.liveliness().declare_token(key(lab, arm.name, "alive")),
        ]

    def _row(self, data: bytes) -> None:
        for arm in self._arms.values():
            arm.row(data)

    def _text(self, message: Mapping[str, Any]) -> None:
        kind, arms = message["kind"], self._arms.values()
        if kind == "answer":
            robot = self._answers.get(message["client"])
            if robot is not None:
                self._answer(robot, message["client"], message["text"])
        elif kind == "parameters":
            for arm in arms:
                arm.texts["parameters"].put(msgspec.json.encode(message))
        elif kind in ("event", "recording"):
            if kind == "recording":
                self._recording = dict(message)
            for arm in arms:
                arm.texts["events"].put(msgspec.json.encode(message))

    def _command(self, robot: str, sample: Any) -> None:
        """Handle a command; if it is invalid, answer with the reason."""
        kind, client = str(sample.key_expr).rpartition("/")[2], _UNKNOWN
        try:
            attached = Attachment.read(data_of(sample.attachment))
            client = attached.client
            self._ask(robot, _order(robot, kind, sample.payload.to_bytes(), attached))
        except CommandRefused as error:
            self._refuse(robot, client, str(error))

    def _set(self, robot: str, sample: Any) -> None:
        name, client = str(sample.key_expr).rpartition("/")[2], _UNKNOWN
        try:
            client = _sender(sample)
            self._ask(robot, SetRequest(client, {name: _setting(name, sample.payload.to_bytes())}))
        except CommandRefused as error:
            self._refuse(robot, client, str(error))

    def _stop(self, robot: str, sample: Any) -> None:
        client = _UNKNOWN
        with contextlib.suppress(CommandRefused):  # a stop is valid from any sender
            client = _sender(sample)
        self._ask(robot, Stop(client))

    def _ask(self, robot: str, request: Request) -> None:
        client = request.client
        if client not in self._answers and len(self._answers) >= _CLIENTS:
            self._answers.pop(next(iter(self._answers)), None)
        self._answers[client] = robot
        self._loop.ask(request)

    def _refuse(self, robot: str, client: str, why: str) -> None:
        self._answer(robot, client, why)
        self._loop.ask(Report(client, why))

    def _answer(self, robot: str, client: str, text: str) -> None:
        self._session.put(key(self._lab, robot, f"answer/{client}"), text)

    def _schema(self, robot: str, query: Any) -> None:
        with query:
            query.reply(key(self._lab, robot, "schema"), self._loop.schema.text)

    def _about(self, robot: str, query: Any) -> None:
        """Reply with the initial data for a viewer: cell, arms, row schema, parameters and recording."""
        messages = [self._loop.about, {"kind": "parameters", "parameters": list(self._loop.parameters.values())}]
        messages += [self._recording] if self._recording else []
        with query:
            query.reply(key(self._lab, robot, "about"), msgspec.json.encode(messages))

    def _value(self, robot: str, query: Any) -> None:
        """Reply with the declarations and values of the queried parameters."""
        with query:
            for name, about in dict(self._loop.parameters).items():
                where = key(self._lab, robot, f"param/{name}")
                if query.key_expr.intersects(type(query.key_expr)(where)):
                    query.reply(where, msgspec.json.encode(about))


class _ArmOutput:
    """Publishers of one arm."""

    KINDS = ("state", "live", "view")

    def __init__(self, loop: LoopEnd, name: str) -> None:
        self.name, self._schema = name, loop.schema
        self._fresh = loop.schema.fields[f"{name}.fresh"].offset
        self.rows: dict[str, Publisher] = {}
        self.texts: dict[str, Publisher] = {}
        self._status: Status | None = None
        self._view, self._report = Pace(_VIEW), Pace(_STATUS)

    def open(self, session: Any, lab: str) -> None:
        kinds = {"state": BlockingPublisher, "live": Publisher, "view": Publisher}
        self.rows = {what: kind(session, key(lab, self.name, what)) for what, kind in kinds.items()}
        self.texts = {
            what: Publisher(session, key(lab, self.name, what)) for what in ("events", "status", "parameters")
        }

    def close(self) -> None:
        for one in self.rows.values():
            if isinstance(one, BlockingPublisher):
                one.close()

    def row(self, data: bytes) -> None:
        """Publish a row if it contains new data from this arm."""
        self._count(data)
        if not any(data[self._fresh : self._fresh + 8]):
            return
        attached = checksum(data)
        self.rows["live"].put(data, attached)
        self.rows["state"].put(data, attached)
        if self._view.takes([self.name], _MONO.unpack_from(data, MONO)[0]):
            self.rows["view"].put(data, attached)

    def _count(self, data: bytes) -> None:
        output = self.texts["status"]
        if not output.wanted:
            self._status = None
            return
        self._status = self._status or Status(self._schema)
        self._status.add(data)
        if self._report.takes([self.name], _MONO.unpack_from(data, MONO)[0]):
            output.put(msgspec.json.encode({"kind": "status", **self._status.summary()}))


def _sender(sample: Any) -> str:
    attachment = data_of(sample.attachment)
    return _UNKNOWN if attachment is None else Attachment.read(attachment).client


def _order(robot: str, kind: str, data: bytes, attached: Attachment) -> CommandRequest:
    if kind not in COMMANDS:
        known = ", ".join(COMMANDS)
        raise CommandRefused(f"Expected the last word of a command's key to be one of {known}, got {kind!r}.")
    fields = COMMANDS[kind].split()
    most = _MOST * len(fields)
    if not data or len(data) % 8 or len(data) > 8 * most:
        raise CommandRefused(f"Expected 1 to {most} float64 numbers for {robot}, 8 bytes each, got {len(data)} bytes.")
    if len(data) % (8 * len(fields)):
        raise CommandRefused(f"Expected as many velocities as positions for {robot}, got {len(data) // 8} numbers.")
    parts = np.frombuffer(data, "<f8").reshape(len(fields), -1)
    numbers = [[value if math.isfinite(value) else None for value in part] for part in parts.tolist()]
    request = CommandRequest(attached.client, robot, seq=attached.seq)
    return msgspec.structs.replace(request, **dict(zip(fields, numbers, strict=True)))


def _setting(name: str, data: bytes) -> Any:
    try:
        if len(data) > _LONGEST:
            raise ValueError(f"{len(data)} bytes")
        return json.loads(data)
    except (ValueError, RecursionError) as error:
        raise CommandRefused(f"Expected the value of {name} as JSON, got {error}.") from None
