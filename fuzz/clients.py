"""Fuzz targets for server clients: rosbridge, ROS over DDS and Zenoh, Zenoh, LabComm, UDP, requests to the loop."""

from __future__ import annotations

import contextlib
import json
import socket
from collections.abc import Callable
from functools import cache
from types import SimpleNamespace
from typing import Any

from armlab import robots
from armlab.bridge.inputs.fusion import Fusion
from armlab.bridge.inputs.parameters import Parameter, Parameters
from armlab.bridge.inputs.sources import UdpSource
from armlab.bridge.servers.labcomm.channels import ArmChannel, ParameterChannel, Peer
from armlab.bridge.servers.messages import parameter_message, read_request
from armlab.bridge.servers.ros.rmw_zenoh import Names, Nodes, Origin
from armlab.bridge.servers.ros.server import Commands
from armlab.bridge.servers.ros.topics import content
from armlab.bridge.servers.rosbridge.engine import Engine
from armlab.bridge.servers.row import RowSchema, read_row
from armlab.bridge.servers.server_end import encoded
from armlab.bridge.servers.zenoh.process import ZenohProcess
from armlab.errors import ArmlabError, CommandRefused, LabCommError
from armlab.log import Column
from armlab.robots import to_toml
from armlab.wire.labcomm import Encoder

_NOW = 10**12


@cache
def _arms() -> dict[str, Any]:
    return {name: robots.load(name) for name in ("yumi_left", "yumi_right")}


@cache
def _schema() -> RowSchema:
    return RowSchema.of(list(_arms().values()))


class _Loop:
    """Loop as seen by a server; every request must be valid for the real loop."""

    def __init__(self) -> None:
        self.schema = _schema()
        self.about: dict[str, Any] = {"cell": "yumi", "robots": {arm.name: to_toml(arm) for arm in _arms().values()}}
        declared = Parameters([Parameter("gain", 0.5, minimum=0.0, maximum=1.0), Parameter("note", "a", "text")])
        said = json.loads(parameter_message(declared))
        self.parameters = {one["name"]: one for one in said["parameters"]}

    def robots(self) -> dict[str, robots.Robot]:
        return _arms()

    def ask(self, request: Any) -> bool:
        """Accept a request."""
        text = encoded(request)
        if len(text) <= 65536:
            read_request(text)
        return True


@cache
def _engine() -> Engine:
    return Engine(_Loop())


def rosbridge(data: bytes) -> None:
    """Text of a rosbridge client, line by line: must not raise, and all output must be valid JSON."""
    engine = _engine()
    session = engine.join("127.0.0.1:5000")
    try:
        for line in data.split(b"\n")[:8]:
            engine.take(session, line.decode(errors="surrogateescape"), _NOW)
        engine.take(session, data, _NOW)
        engine.tick(_NOW + 2 * 10**9)
        for one in session.outbox.take(2**30):
            json.loads(one)
    finally:
        engine.leave(session)


@cache
def _commands() -> Commands:
    return Commands("yumi", _arms())


def ros_command(data: bytes) -> None:
    """ROS message in CDR, or its content in JSON as sent by the ROS 1 node; the first byte selects the topic."""
    topics = list(_commands().types)
    topic, raw = topics[(data[0] if data else 0) % len(topics)], data[1:]
    reads: list[Callable[[], Any]] = [lambda: content(_commands().types[topic], raw)]
    try:
        said = json.loads(raw)
    except (ValueError, RecursionError):
        pass
    else:
        reads.append(lambda: said)
    for read in reads:
        try:
            for request in _commands().requests(topic, read(), "me"):
                _Loop.ask(None, request)  # type: ignore[arg-type]
        except CommandRefused:
            pass


def _graph(data: bytes) -> None:
    """Graph tokens, one per line; the bytes after the last line are the attachment of a message."""
    *tokens, attached = data.split(b"\n")
    nodes = Nodes(lambda client: None)
    for number, token in enumerate(tokens[:16]):
        nodes.token(token.decode(errors="replace"), number % 3 != 2)
    origin = Origin.read(attached)
    if origin is not None:
        assert origin.pack() == attached
        assert nodes.client(origin)
    name = tokens[0].decode(errors="replace") if tokens else ""
    names = Names(0, "a1")
    assert names.data(name, "std_msgs/msg/String").startswith("0/")


class _Bytes(SimpleNamespace):
    def to_bytes(self) -> bytes:
        """Return the bytes, as Zenoh's own type does."""
        return self.raw


@cache
def _zenoh() -> ZenohProcess:
    server = object.__new__(ZenohProcess)  # without a session
    server._loop, server._lab, server._answers = _Loop(), "lab", {}  # type: ignore[assignment]
    server._session = SimpleNamespace(put=lambda key, text: text.encode())
    return server


def zenoh(data: bytes) -> None:
    """Command, setting or stop over Zenoh: length and last word of the key, length and attachment, payload.

    The same bytes are also used as tokens and attachments of rmw_zenoh.
    """
    _graph(data)
    first = data[0] if data else 0
    word, data = data[1 : 1 + first], data[1 + first :]
    second = data[0] if data else 0
    attached = _Bytes(raw=data[1 : 1 + second]) if second else None
    name = word.decode(errors="replace") or "position"
    sample = SimpleNamespace(key_expr=f"armlab/lab/yumi_left/command/{name}", payload=_Bytes(raw=data[1 + second :]))
    sample.attachment = attached
    for take in (_zenoh()._command, _zenoh()._set, _zenoh()._stop):
        take("yumi_left", sample)


def labcomm_client(data: bytes) -> None:
    """Data from a LabComm client: commands to an arm's port, or settings."""
    ours, theirs = socket.socketpair()
    with ours, theirs:
        peer = Peer(ours, "127.0.0.1:5000", Encoder())
        values = {"gain": 0.5, "on": True, "note": "a", "list": [1.0, 2.0]}
        channels = ArmChannel("left", 0, lambda *said: None), ParameterChannel(values)
        channel = channels[(data[0] if data else 0) % 2]
        channel.greet(peer)
        try:
            for event in peer.decoder.feed(data[1:]):
                with contextlib.suppress(LabCommError):
                    channel.take(peer, event, [peer])
        except LabCommError:
            pass
        channel.left(peer)


def _datagram(data: bytes) -> None:
    fields = {"force": Column(shape=(3,), unit="N", frame="base"), "on": Column(unit="1")}
    for layout in ("json", {"force": "<f4", "on": "u1", "seq": "<u8"}):
        source = UdpSource("sensor", fields, 0.01, 0, layout)  # type: ignore[arg-type]
        fusion = Fusion([source])
        if source._take(data, _NOW, 1):
            source._take(data, _NOW + 1, 1)
            fusion.record(fusion.tick(_NOW), _NOW)
        else:
            assert source.drops == 1


def request(data: bytes) -> None:
    """Request to the loop, row, row schema, or datagram for a data source."""
    _datagram(data)
    reads = (read_request, RowSchema.read, lambda raw: dict(read_row(_schema(), raw).values))
    for read in reads:
        with contextlib.suppress(ArmlabError):
            read(data)
