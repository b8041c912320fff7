"""`ZenohFeed`, the counterpart of `LocalFeed` for remote bridges, and the port and codec of a Zenoh link."""

from __future__ import annotations

import json
import secrets
import time
from contextlib import AbstractContextManager
from typing import Any, cast

import numpy as np

from armlab.bridge.net.sockets import Arrival, Port, pair
from armlab.bridge.servers.messages import Request, SetRequest, Stop, Subscribe
from armlab.bridge.servers.row import Pace, Row, RowsAsPackets, RowSchema, clock_ms, read_row
from armlab.bridge.servers.zenoh.messages import (
    EVERY,
    About,
    Attachment,
    Gaps,
    Inbox,
    key,
    read_about,
    read_message,
    robot_of,
    undamaged,
)
from armlab.bridge.servers.zenoh.session import Discovery, LabAddress, close_session, zenoh
from armlab.errors import ArmlabError, ConfigError, LinkError, UnknownName
from armlab.robots import Robot
from armlab.wire.egm import Codec, Drop, Packet, Reference

_VIEW = 30.0  # rows/s on the key "view"
_DISCOVERY = 0.5  # s allowed for discovering all robots of a lab
_KEPT = 5000  # maximum number of queued messages, beyond which the oldest are dropped
_TEXT = 2**16  # bytes: nominal size of a text message in the inbox


def robots_at(session: Any, lab: str = EVERY, patience: float = 1.0) -> list[tuple[str, str]]:
    """Return the lab and name of each robot with a running bridge."""
    replies = session.liveliness().get(key(lab, EVERY, "alive"), timeout=patience)
    return sorted({robot_of(str(reply.ok.key_expr)) for reply in replies if reply.ok is not None})


class ZenohFeed(AbstractContextManager["ZenohFeed"]):
    """Client of a bridge on another computer, with the methods of `LocalFeed`."""

    damaged: int = 0
    lost: int = 0
    refused: int = 0

    def __init__(self, url: str, robot: str = "", patience: float = 5.0) -> None:
        self._place, self._patience = LabAddress.read(url), patience
        self._messages: Inbox[bytes | dict[str, Any]] = Inbox(_KEPT)
        self._next: bytes | dict[str, Any] | None = None
        self._rows: list[Any] = []
        self._gaps: dict[str, Gaps] = {}  # only for robots with a subscription to every row
        self._pace: Pace | None = None
        self._gone: float | None = None  # time of the disconnection
        self._is_unsure = False  # True until a reconnected bridge has reported its run
        self._session = self._place.open(patience)
        try:
            known = [robot] if robot else self._robots()
            arm = known[0]
            about = _whole(self._place.ask(self._session, key(self._place.lab, arm, "about"), patience))
            self._schema = about.schema
            if not set(known) <= set(self._schema.robots):
                names = ", ".join(known)
                raise ConfigError(f"Expected a robot name, because this lab has several cells: {names}.")
        except BaseException:
            self.close()
            raise
        self.cell: str = about.cell
        self._arm, self._run = arm, about.run
        self._take(*about.messages)
        self._discovery = Discovery(self._session, self._answered)
        declare, lab = self._session.declare_subscriber, self._place.lab
        self._texts = [declare(key(lab, arm, what), self._take_text) for what in ("events", "status", "parameters")]
        self._alive = self._session.liveliness().declare_subscriber(
            key(lab, arm, "alive"), self._take_life, history=True
        )

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        close_session(self._session)

    def wait(self, seconds: float) -> bool:
        """Return whether a message arrives within this time [s]."""
        if self._next is None:
            self._next = self._messages.get(0.0 if self._has_ended() else seconds)
        return self._next is not None or self._has_ended()

    def ask(self, request: Request) -> None:
        """Send a request: `Subscribe`, `SetRequest` or `Stop`."""
        lab, robot = self._place.lab, self._schema.robots[0]
        if isinstance(request, Subscribe):
            self._subscribe(request.rate)
        elif isinstance(request, SetRequest):
            for name, value in request.values.items():
                self._session.put(key(lab, robot, f"param/{name}"), json.dumps(value))
        elif isinstance(request, Stop):
            self._session.put(key(lab, robot, "stop"), b"")
        else:
            what = type(request).__name__
            raise ConfigError(
                f"Expected a request that Zenoh supports, got {what}. "
                "Send the request from the computer that runs the bridge."
            )

    def receive(self) -> Row | dict[str, Any]:
        """Return the next message: a row, or the fields of any other message, including its "kind"."""
        until = time.monotonic() + self._patience
        while self.wait(until - time.monotonic()):
            message, self._next = self._next, None
            if message is None:
                break
            if isinstance(message, dict):
                if message["kind"] == "about":
                    self._schema = RowSchema.read(message["schema"].encode())
                    there = [robot for robot in self._gaps if robot in self._schema.robots]
                    self._gaps = {robot: Gaps(self._schema, robot) for robot in there}
                return message
            if message[8:16] == self._schema.id:  # otherwise the row is from a run that has not been announced yet
                row = read_row(self._schema, message)
                self._count(row, message)
                return row
        if self._gone is not None:
            raise LinkError(f"Expected the bridge of {self.cell} to keep running, but the bridge has disappeared.")
        seconds = f"{self._patience:g} s"
        raise LinkError(f"Expected a message from {self.cell} within {seconds}, got none. Check its robot.")

    def _subscribe(self, rate: float | None) -> None:
        for one in self._rows:
            one.undeclare()
        self._rows = []
        self._gaps = {robot: Gaps(self._schema, robot) for robot in self._schema.robots if rate is None}
        if rate is None or rate > 0.0:
            what = "live" if rate is None or rate > _VIEW else "view"
            self._pace = None if rate is None else Pace(1.0 / rate)
            self._rows = [
                self._session.declare_subscriber(key(self._place.lab, robot, what), self._take_row)
                for robot in self._schema.robots
            ]

    def _count(self, row: Row, data: bytes) -> None:
        """Count missing rows, because Zenoh does not report the rows that it drops for a slow reader."""
        before = self.lost.bit_length()
        self.lost += sum(gaps.take(data) for robot, gaps in self._gaps.items() if row.values[f"{robot}.fresh"])
        if self.lost.bit_length() > before:  # 1, 2, 4, ...
            self._report(f"Rows were lost in transit or not read in time: {self.lost} so far.")

    def _robots(self) -> list[str]:
        """Wait until the session has discovered the robots of the lab, and return their names."""
        found: set[str] = set()
        until = time.monotonic() + _DISCOVERY
        while time.monotonic() < until:
            found |= {name for _, name in robots_at(self._session, self._place.lab)}
            time.sleep(_DISCOVERY / 10)
        if not found:
            raise LinkError(
                f"Expected a robot in the lab {self._place.lab!r} at {self._place.host}:{self._place.port}, got none. "
                "Start armlab bridge with [servers.zenoh], or choose another lab."
            )
        return sorted(found)

    def _take_row(self, sample: Any) -> None:
        if self._is_unsure:
            self._discovery.ask(self._place.lab, self._arm)
        elif (data := undamaged(sample)) is None:
            self.damaged += 1
            if self.damaged & (self.damaged - 1) == 0:  # report at 1, 2, 4, ... to limit the number of events
                self._report(f"Rows arrived corrupted and were dropped: {self.damaged} so far.")
        elif self._pace is None or self._pace.takes([robot_of(str(sample.key_expr))], time.monotonic()):
            self._take(data)

    def _take_text(self, sample: Any) -> None:
        try:
            self._take(read_message(sample.payload.to_bytes()))
        except LinkError:
            self._refuse()

    def _refuse(self) -> None:
        self.refused += 1
        if self.refused & (self.refused - 1) == 0:  # 1, 2, 4, ...
            self._report(f"Invalid messages were dropped: {self.refused} so far.")

    def _take_life(self, sample: Any) -> None:
        has_gone = sample.kind == zenoh().SampleKind.DELETE
        self._gone = time.monotonic() if has_gone else None
        if has_gone:
            self._is_unsure = True
            self._report(f"The bridge of {self.cell} or the connection to it was lost.")

    def _has_ended(self) -> bool:
        gone = self._gone  # may be changed by a Zenoh thread
        return gone is not None and time.monotonic() - gone >= self._patience

    def _answered(self, lab: str, robot: str, about: bytes) -> None:
        """Handle the reply of a bridge that is reachable again."""
        if not self._is_unsure:
            return
        try:
            reply = _whole(about)
        except ArmlabError:
            self._refuse()
            return
        self._is_unsure = False
        if reply.run == self._run:
            self._report(f"The bridge of {self.cell} is reachable again, in the same run.")
            return
        self._run = reply.run
        self._take(*reply.messages)
        self._report(f"The bridge of {self.cell} has restarted.")

    def _report(self, text: str) -> None:
        self._take({"kind": "event", "stamp_ns": time.time_ns(), "text": text})

    def _take(self, *messages: bytes | dict[str, Any]) -> None:
        """Queue messages from a Zenoh thread and wake the reader."""
        for message in messages:
            self._messages.put(message, len(message) if isinstance(message, bytes) else _TEXT)


def _whole(data: bytes) -> About:
    """Decode a bridge's reply to "about"; raise an error if its rows lack a field that `Watch` reads."""
    about = read_about(data)
    for robot in about.robots.values():
        about.schema.require(robot)
    return about


_LARGEST = 2**14
_DAMAGED = b"damaged"  # replaces a corrupted row
_USED = (
    *("q", "qd", "tau", "q_planned", "q_ext", "seq", "robot_ns", "session_t", "T_frame_tool", "wrench_raw"),
    *("motors", "mci", "rapid", "converged", "utilization"),
)


def far_end(robot: Robot, host: str, port: int, options: dict[str, str]) -> tuple[Port, Codec]:
    """Return the port and codec of an arm behind a Zenoh server."""
    end = ZenohPort(robot, LabAddress.of(host, port, options))
    return cast(Port, end), ZenohCodec(robot, end.schema)


class ZenohPort:
    """Port that receives the rows of an arm from Zenoh threads instead of datagrams; it never blocks."""

    host: str
    port: int
    errors: int

    def __init__(self, robot: Robot, place: LabAddress) -> None:
        self.host, self.port, self.errors = place.host, place.port, 0
        self._session = place.open()
        self._seq, self._sender = 0, secrets.token_bytes(16)
        try:
            self.schema: RowSchema = RowSchema.read(place.ask(self._session, key(place.lab, robot.name, "schema")))
            _check(self.schema, robot)
        except ArmlabError:
            close_session(self._session)
            raise
        self.gaps: Gaps = Gaps(self.schema, robot.name)
        self._inner, self._outer = pair()
        self._outer.setblocking(False)
        drop = zenoh().CongestionControl.DROP
        self._commands = {
            kind: self._session.declare_publisher(
                key(place.lab, robot.name, f"command/{kind}"), congestion_control=drop, express=True
            )
            for kind in ("position", "motion")
        }
        self._n = robot.n
        self._rows = self._session.declare_subscriber(key(place.lab, robot.name, "live"), self._take)

    def fileno(self) -> int:
        return self._outer.fileno()

    def close(self) -> None:
        close_session(self._session)
        self._inner.close()
        self._outer.close()

    def receive(self) -> Arrival | None:
        """Return the next row, or None."""
        try:
            data = self._outer.recv(_LARGEST)
        except OSError:
            return None
        return Arrival(data, (self.host, self.port), time.monotonic_ns()) if data else None

    def flush(self) -> None:
        """Discard all queued rows."""
        for _ in range(4000):
            if self.receive() is None:
                break

    def send(self, data: bytes, to: tuple[str, int]) -> bool:
        """Send one command; return whether Zenoh accepted it."""
        self._seq += 1
        kind = "position" if len(data) == 8 * self._n else "motion"
        try:
            self._commands[kind].put(data, attachment=Attachment(self._sender, self._seq, time.time_ns()).pack())
        except zenoh().ZError:
            self.errors += 1
            return False
        return True

    def _take(self, sample: Any) -> None:
        data = undamaged(sample) or _DAMAGED
        if data[8:16] == self.schema.id and len(data) == self.schema.size:
            self.gaps.take(data)
        try:
            self._inner.send(data)
        except OSError:  # full or closed
            self.errors += 1


class ZenohCodec(RowsAsPackets):
    """Codec that converts rows to packets for the loop, and references to commands."""

    def __init__(self, robot: Robot, schema: RowSchema) -> None:
        super().__init__()
        _check(schema, robot)
        self._name, self._schema = robot.name, schema

    def decode(self, data: bytes) -> Packet | Drop:
        """Convert a row to a packet, or return the reason for dropping the row."""
        if data == _DAMAGED:
            return Drop("damaged", "a row with a wrong checksum")
        try:
            values = read_row(self._schema, data).values
        except LinkError as error:
            return Drop("unparsable", str(error))
        one = {name: values[f"{self._name}.{name}"] for name in _USED}
        tm_ms = clock_ms(one["robot_ns"], one.pop("session_t"))
        if tm_ms is None:
            return Drop("not finite", "the time of a row")
        q_ext = one.pop("q_ext")
        return self._packet(
            seqno=one.pop("seq") % 2**32,
            tm_ms=tm_ms % 2**32,
            q_ext=q_ext[np.isfinite(q_ext)],
            converged=one.pop("converged") == 1,
            **one,
        )

    def encode(self, ref: Reference) -> bytes:
        """Encode a command: positions, or positions and velocities."""
        parts = [ref.q] if ref.qd is None else [ref.q, ref.qd]
        return np.concatenate(parts).astype("<f8").tobytes()


def _check(schema: RowSchema, robot: Robot) -> None:
    """Raise an error if the rows do not contain this arm, or contain a different arm with the same name."""
    if robot.name not in schema.robots:
        raise UnknownName.among("robot of the bridge", robot.name, schema.robots)
    schema.require(robot)
